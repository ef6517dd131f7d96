from pathlib import Path

import numpy as np
import pytest

from advnerf_core.learning.frames import Frames, FrameSet, FrameStore, FrameStoreError


def _frames(count: int, base: int = 0) -> Frames:
    index = np.arange(count)
    images = np.zeros((count, 66, 200, 3), np.uint8) + (base + index)[:, None, None, None].astype(np.uint8)
    return Frames(
        images,
        np.zeros((count, 3)),
        (base + index).astype(np.float32),
        np.zeros((count, 0), np.float32),
        index % 2 == 1,
    )


def test_shards_survive_and_are_memory_mapped(tmp_path: Path) -> None:
    store = FrameStore(tmp_path / "frames")
    assert store.names() == []
    store.append("b", _frames(3, 10))
    store.append("a", _frames(2))
    assert FrameStore(tmp_path / "frames").names() == ["a", "b"]
    shard = store.load("b")
    assert isinstance(shard.images, np.memmap)
    np.testing.assert_array_equal(shard.steering_rad, [10, 11, 12])
    with pytest.raises(FrameStoreError, match="new shard name"):
        store.append("a", _frames(1))


def test_a_failed_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = FrameStore(tmp_path)
    monkeypatch.setattr(
        np, "save", lambda *_, **__: (_ for _ in ()).throw(OSError("no space left on device"))
    )
    with pytest.raises(OSError, match="no space"):
        store.append("a", _frames(2))
    assert list(tmp_path.iterdir()) == []


def test_damaged_shards_and_wrong_shapes_are_explained(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    store.append("a", _frames(2))
    (tmp_path / "a" / "steering_rad.npy").unlink()
    with pytest.raises(FrameStoreError, match="delete it and collect again"):
        store.load("a")
    good = _frames(2)
    with pytest.raises(FrameStoreError, match="one length"):
        Frames(good.images, good.states, good.steering_rad[:1], good.goals, good.textured)
    with pytest.raises(FrameStoreError, match="finite steering"):
        Frames(good.images, good.states, good.steering_rad * np.nan, good.goals, good.textured)


def test_choice_of_frames_and_hold_out() -> None:
    everything = FrameSet([_frames(40), _frames(10, 100)])
    assert len(everything.training) == 50
    plain = FrameSet([_frames(40), _frames(10, 100)], include_textured=False)
    images, labels, goals = plain.batch(plain.training[[0, 1, 20]])
    assert labels.tolist() == [0, 2, 100]
    assert images[:, 0, 0, 0].tolist() == [0, 2, 100]
    assert goals.shape == (3, 0)
    split = FrameSet([_frames(40)], holdout_every=2)
    assert split.held_out[:, 1].tolist() == list(range(16, 32))
    assert len(split.training) == 24
