import av
import numpy as np
import pytest

from advnerf_core.report import clips


def track(title="deployed, gradient", count=7, height=50, width=320, condition="gradient"):
    rng = np.random.default_rng(0)
    base = rng.integers(0, 255, (height // 10, width // 10, 3)).repeat(10, axis=0).repeat(10, axis=1)
    frames = [np.roll(base, 4 * i, axis=1).astype(np.uint8) for i in range(count)]
    return clips.ClipTrack(title, condition, frames, np.linspace(0, -0.8, count), "abc123")


def test_a_clip_decodes_to_the_frames_that_were_written(tmp_path):
    tracks = [track(), track("deployed, no attack", 5, condition="none")]
    path = clips.write_clip(tmp_path / "pair.mp4", tracks)
    written = np.stack(list(clips.compose(tracks)))
    decoded = clips.read_clip(path)
    assert decoded.shape == written.shape == (7, 50 + 44, 2 * 320 + 6, 3)
    assert np.abs(decoded.astype(float) - written).mean() < 8  # lossy, and colour at half resolution
    assert path.stat().st_size < clips.MAX_BYTES
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_the_first_person_image_is_shown_as_it_is():
    t = track()
    frame = next(clips.compose([t]))
    np.testing.assert_array_equal(frame[44:], t.frames[0])


def test_small_frames_are_doubled_and_odd_sizes_padded():
    frame = next(clips.compose([track(height=30, width=210, count=1)]))
    assert frame.shape == (104, 420, 3)
    odd = clips.ClipTrack("odd", "none", np.zeros((1, 41, 333, 3), np.uint8), [0.0])
    assert next(clips.compose([odd])).shape == (86, 334, 3)


def test_the_caption_changes_when_the_car_leaves():
    frames = np.zeros((2, 40, 336, 3), np.uint8)
    same = clips.ClipTrack("a", "none", frames, [0.1, 0.1])
    left = clips.ClipTrack("a", "none", frames, [0.1, 0.5])
    on, off = (list(clips.compose([t]))[1] for t in (same, left))
    assert (on != off)[22:44].any()
    assert not (on != off)[44:].any()


def test_a_clip_over_the_limit_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(clips, "MAX_BYTES", 100)
    with pytest.raises(ValueError, match="under 100 bytes"):
        clips.write_clip(tmp_path / "big.mp4", [track(count=3)])
    assert list(tmp_path.iterdir()) == []


def test_bad_tracks_are_named():
    with pytest.raises(ValueError, match="one cross-track error per frame of 'x'"):
        clips.ClipTrack("x", "none", np.zeros((3, 4, 4, 3), np.uint8), [0.0])
    with pytest.raises(ValueError, match="one frame size"):
        list(clips.compose([track(), track(height=60)]))


def test_the_poster_of_a_film_is_where_the_last_drive_is_farthest_from_its_path(tmp_path):
    tracks = [track("no attack", condition="none"), track("attack")]
    tracks[1].cte_m[:] = [0.0, 0.1, -0.2, -0.9, 0.3, 0.2, 0.1]
    film = clips.write_film(tmp_path / "pair.mp4", tracks, 10.0, 0.4)
    assert (film.titles, film.moment) == (("no attack", "attack"), 3)
    written = clips.read_clip(film.file)
    np.testing.assert_array_equal(clips.frame_of(film.file, film.moment), written[3])
    np.testing.assert_array_equal(clips.frame_of(film.file, 99), written[-1])


def test_a_video_is_h264_of_even_size_and_appears_when_it_is_complete(tmp_path):
    frames = np.full((4, 41, 64, 3), 200, np.uint8)
    path = clips.write_video(tmp_path / "new" / "v.mp4", iter(frames))
    assert [each.name for each in path.parent.iterdir()] == ["v.mp4"]
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
    assert np.abs(clips.read_clip(path).astype(float) - frames[:, :40]).max() < 8

    # Of a control period that is no whole number of frames a second.
    for rate_hz in (1.0 / 0.15, 2.5, 10.0 / 1.2):
        with av.open(str(clips.write_video(tmp_path / "new" / "v.mp4", iter(frames), rate_hz))) as container:
            stream = container.streams.video[0]
            assert float(stream.average_rate) == pytest.approx(rate_hz, rel=1e-3)
            assert float(stream.duration * stream.time_base) == pytest.approx(4.0 / rate_hz, rel=1e-3)

    def broken():
        yield frames[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clips.write_video(tmp_path / "new" / "w.mp4", broken())
    assert [each.name for each in path.parent.iterdir()] == ["v.mp4"]
