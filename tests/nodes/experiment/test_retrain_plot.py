import cv2
import numpy as np

from nodes.experiment.steps.retrain_plot import curve, draw


def test_every_round_of_every_drive_is_seen_and_where_the_loop_ends(tmp_path):
    rounds = [
        {"surrogate": {"straight": 75.0, "right": 148.0}, "deployed": {"straight": 34.0, "right": 69.0}},
        {"surrogate": {"straight": 1.2, "right": 3.0}, "deployed": {"straight": 0.7, "right": 1.9}},
    ]
    (axes,) = curve(rounds, 1.5).axes
    low, high = axes.get_ylim()
    drawn = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()}
    assert drawn["right, surrogate"].tolist() == [148.0, 3.0]
    assert drawn["straight, deployed"].tolist() == [34.0, 0.7]
    assert all(low <= values.min() and values.max() <= high for values in drawn.values())
    assert drawn["pays from 1.5"].tolist() == [1.5, 1.5]
    draw(tmp_path / "curve.png", rounds[:1], 1.5)
    assert cv2.imread(str(tmp_path / "curve.png")).shape == (440, 880, 3)
