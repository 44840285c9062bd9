"""Medians over seeds, and where one method gets ahead of another."""

import numpy as np

from dln_jax.locomotion.learning import Record
from dln_jax.training.locomotion import median_to_reach
from scripts.reports.locomotion import comparison


def test_medians_and_the_crossover():
    def records(*pairs):
        return [Record(steps, steps / 10, distance, 0) for steps, distance in pairs]

    quick = [records((10, 0.1), (20, 1.1)), records((10, 0.3), (20, 0.2), (30, 1.0)), records((10, 0.2), (40, 1.5))]
    slow = [records((5, 0.4), (100, 1.2)), records((5, 0.5), (100, np.nan))]
    assert median_to_reach(quick, 1.0, "steps") == 30
    assert median_to_reach(slow, 1.0, "steps") == np.inf
    places, heights = comparison.median_curve(quick, "steps")
    np.testing.assert_array_equal(places, [10, 20, 30, 40])
    np.testing.assert_allclose(heights, [0.2, 0.3, 1.0, 1.1])
    # Behind from 5 to 20, ahead from 30 on.
    assert comparison.crossover(quick, slow, "steps") == 30
    assert comparison.crossover(slow, quick, "steps") is None
    axes = comparison.comparison_figure({"gradient": quick, "ppo": slow}, distance=1.0, title="").axes
    assert [axis.get_xscale() for axis in axes] == ["log", "log"]
    said = {text.get_text() for text in axes[0].get_legend().get_texts()}
    assert said == {"gradient: 30", "ppo: not reached", "from here gradient is ahead"}
    (ahead,) = (line for line in axes[0].lines if line.get_label().startswith("from here"))
    np.testing.assert_array_equal(ahead.get_xdata(), 30)
