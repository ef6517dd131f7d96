import cv2
import numpy as np

from nodes.experiment.steps.retrain_plot import curve, draw


def test_every_round_of_every_drive_is_seen_and_where_the_loop_ends(tmp_path):
    rounds = [
        {"surrogate": {"straight": 1.2, "right": 2.4}, "deployed": {"straight": 0.9, "right": 2.1}},
        {"surrogate": {"straight": 0.1, "right": -0.01}, "deployed": {"straight": 0.2, "right": 0.3}},
    ]
    (axes,) = curve(rounds, 0.175).axes
    low, high = axes.get_ylim()
    drawn = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()}
    assert drawn["right, surrogate"].tolist() == [2.4, -0.01]
    assert drawn["straight, deployed"].tolist() == [0.9, 0.2]
    assert all(low <= values.min() and values.max() <= high for values in drawn.values())
    assert drawn["pays above 0.175 m"].tolist() == [0.175, 0.175]
    draw(tmp_path / "curve.png", rounds[:1], 0.175)
    assert cv2.imread(str(tmp_path / "curve.png")).shape == (440, 880, 3)
