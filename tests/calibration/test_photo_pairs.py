import numpy as np

from calibration.photo_pairs import chosen_pairs, every_pair, looks


def places(count=5, images_each=4, features=120, seed=0):
    """Features of images of several places: those of one place are noisy copies of each other."""
    rng = np.random.default_rng(seed)
    descriptors = []
    for _ in range(count):
        scene = rng.gamma(0.5, 40.0, (features, 128))
        for _ in range(images_each):
            seen = scene[rng.choice(features, 90, replace=False)] + rng.normal(0.0, 4.0, (90, 128))
            descriptors.append(np.clip(seen, 0, 255).astype(np.uint8))
    return descriptors


def test_images_of_one_place_look_most_alike():
    similarity = looks(places(), seed=0)
    np.testing.assert_allclose(np.diag(similarity), 1.0, atol=1e-5)
    np.fill_diagonal(similarity, -1.0)
    for image, row in enumerate(similarity):
        nearest = np.argsort(-row)[:3]
        assert {int(n) // 4 for n in nearest} == {image // 4}


def test_neighbours_in_time_and_look_alikes_are_paired_once():
    descriptors = places()
    order = [0, 4, 8, 12, 16, 1, 5, 9, 13, 17]  # a video through all places, twice
    pairs = chosen_pairs(descriptors, [order], overlap=2, look_alikes=3, seed=0)
    assert len(pairs) == len(set(pairs))
    assert all(a < b for a, b in pairs)
    assert {(0, 4), (0, 8), (4, 8), (1, 16)} <= set(pairs), "neighbours in the video"
    assert {(min(order[i], order[i + 4]), max(order[i], order[i + 4])) for i in range(6)} <= set(pairs), (
        "and at powers of two"
    )
    assert {(0, 1), (2, 3), (18, 19)} <= set(pairs), "images of one place"
    assert len(pairs) < len(every_pair(20)) / 2


def test_the_choice_is_repeatable_and_images_without_features_do_no_harm():
    descriptors = [*places(), np.zeros((0, 128), np.uint8)]
    first = chosen_pairs(descriptors, [], 2, 3, seed=5)
    assert first == chosen_pairs(descriptors, [], 2, 3, seed=5)
    assert np.isfinite(looks(descriptors, 0)).all()
    assert np.isfinite(looks([np.zeros((0, 128), np.uint8)] * 3, 0)).all()
