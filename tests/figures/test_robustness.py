"""The map of successes says each number, and sets own controllers apart."""

from scripts.reports.figures.robustness import shares


def test_each_plant_has_a_panel_with_its_numbers():
    row = {"delay": 0.25, "mean": 1.0}
    figure = shares({"acrobot": {"ours-planned": row, "AR-EAPO": row}, "pendubot": {"ours-planned": row}})
    assert [len(axis.texts) for axis in figure.axes] == [4, 2]
    first = figure.axes[0]
    assert [text.get_text() for text in first.texts] == ["25", "100"] * 2
    assert [label.get_text() for label in first.get_yticklabels()] == ["ours planned", "AR-EAPO"]
