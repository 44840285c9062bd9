"""Figures have one width, and one look for each model."""

import itertools

import matplotlib
import numpy as np
import pytest

from dln_jax.figures import style

# How the colour-blind see linear RGB (Machado, Oliveira and Fernandes 2009, severity 1).
SEEN = {
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "neither": np.eye(3),
}
TOGETHER = (
    ("structured-delan", "black-box-delan", "structured-hnn", "black-box-hnn", "trigonometric", "feed-forward"),
    ("separable-hnn", "black-box-hnn", "polynomial-hamiltonian", "phase-network"),
    ("pairwise-hnn", "black-box-hnn", "phase-network"),
)
"""Models that one figure shows."""


def seen_as(colour, matrix):
    encoded = np.array(matplotlib.colors.to_rgb(colour))
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(matrix) @ linear, 0, 1)
    return np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)


def test_models_of_one_figure_are_told_apart():
    for models in TOGETHER:
        for matrix in SEEN.values():
            colours = [seen_as(style.colour(name), matrix) for name in models]
            assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(colours, 2)) > 0.15


def test_a_variant_looks_like_its_model_and_an_unknown_name_is_grey():
    assert style.colour("structured-delan-64x64") == style.colour("structured-delan")
    assert style.colour("structured") == style.UNKNOWN and style.colour("truth") == "black"


def test_a_figure_is_as_wide_as_a_page_and_settings_stay():
    before = dict(matplotlib.rcParams)
    figure, _ = style.figure(height=2.0)
    figure.draw_without_rendering()
    assert figure.get_figwidth() * figure.dpi == pytest.approx(1080)
    assert dict(matplotlib.rcParams) == before


def test_logarithms_are_for_a_decade_or_more_and_prefixes_for_small_numbers():
    assert style.scale_of([1.0, 5.0]) == "linear" and style.scale_of([1.0, 10.0, np.nan]) == "log"
    assert style.scale_of([0.0, 10.0]) == "linear" and style.scale_of([]) == "linear"
    assert style.prefixed(3e-5, "N m") == (1e-6, "µN m") and style.prefixed(5e3, "J") == (1e3, "kJ")
    assert style.prefixed(0.0, "J") == (1.0, "J") and style.prefixed(1e-18, "J") == (1e-15, "fJ")
