"""Logs of a drive as other software writes them. Image ``k`` is uniformly ``GREY * k`` and its steering ``(k - 6) / 10``."""

import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

COUNT, GREY, FPS = 12, 20, 10
CAMERA = "observation.images.front"


def value(k: int) -> float:
    return (k - 6) / 10


def picture(k: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), GREY * k, np.uint8)


def write_tub_2(
    folder: Path,
    deleted: Collection[int] = (),
    piloted: Collection[int] = (),
    size: tuple[int, int] = (48, 64),
    step_ms: int | None = 100,
    count: int = COUNT,
) -> Path:
    """As ``donkeycar/parts/tub_v2.py`` writes it, five records to a catalog; without times if there is no step."""
    (folder / "images").mkdir(parents=True)
    catalogs: dict[str, list[str]] = {}
    for k in range(count):
        name = f"{k}_cam_image_array_.jpg"
        cv2.imwrite(str(folder / "images" / name), picture(k % COUNT, *size))
        record: dict[str, Any] = {
            "cam/image_array": name,
            "user/angle": value(k % COUNT),
            "user/throttle": 0.4,
        }
        record |= {"user/mode": "local" if k in piloted else "user"}
        record |= {} if step_ms is None else {"_timestamp_ms": 1700000000000 + step_ms * k}
        catalogs.setdefault(f"catalog_{k // 5}.catalog", []).append(
            json.dumps(record | {"_index": k, "_session_id": "26-11-26_0"})
        )
    for name, lines in catalogs.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    state = {"paths": list(catalogs), "current_index": count, "max_len": 5, "deleted_indexes": list(deleted)}
    rows: list[Any] = [
        ["cam/image_array", "user/angle"],
        ["image_array", "float"],
        {},
        {"created_at": 1.0},
        state,
    ]
    (folder / "manifest.json").write_text("\n".join(map(json.dumps, rows)) + "\n")
    return folder


def write_tub_1(folder: Path, removed: Collection[int] = (), excluded: Collection[int] = ()) -> Path:
    """As ``donkeycar/parts/datastore.py`` writes it; records from 1 on."""
    folder.mkdir(parents=True)
    for k in range(COUNT):
        name = f"{k + 1}_cam-image_array_.jpg"
        cv2.imwrite(str(folder / name), picture(k))
        record = {
            "cam/image_array": name,
            "user/angle": value(k),
            "user/mode": "user",
            "milliseconds": 100 * k,
        }
        if k + 1 not in removed:
            (folder / f"record_{k + 1}.json").write_text(json.dumps(record))
    (folder / "meta.json").write_text(
        json.dumps({"inputs": ["cam/image_array", "user/angle"], "types": ["image_array", "float"]})
    )
    if excluded:
        (folder / "exclude.json").write_text(json.dumps(list(excluded)))
    return folder


def write_udacity(folder: Path, header: bool, prefix: str = "") -> Path:
    """``driving_log.csv`` beside ``IMG``, with paths of the recording computer."""
    (folder / "IMG").mkdir(parents=True)
    lines = ["center,left,right,steering,throttle,brake,speed"] if header else []
    for k in range(COUNT):
        names = [f"{side}_2026_11_26_10_00_{k:02d}_000.jpg" for side in ("center", "left", "right")]
        for shift, name in enumerate(names):
            cv2.imwrite(str(folder / "IMG" / name), np.maximum(picture(k), shift))
        lines.append(
            ",".join([*(prefix + name for name in names), f" {value(k)}", " 0.5", " 0", " 9.530424E-06"])
        )
    (folder / "driving_log.csv").write_text("\n".join(lines) + "\n")
    return folder


def write_lerobot_2(folder: Path, names: Sequence[str] = ("steering", "throttle")) -> Path:
    """Version 2.1: one table and one video for each episode."""
    info = _info("v2.1", "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet", names)
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    _write_json(folder / "meta/info.json", info)
    for episode, numbers in enumerate(np.array_split(np.arange(COUNT), 3)):
        _table(
            folder / f"data/chunk-000/episode_{episode:06d}.parquet",
            numbers,
            [episode] * len(numbers),
            [*range(len(numbers))],
        )
        _video(folder / f"videos/chunk-000/{CAMERA}/episode_{episode:06d}.mp4", numbers)
    return folder


def write_lerobot_3(
    folder: Path, names: Sequence[str] = ("steering", "throttle"), images: str = "video"
) -> Path:
    """Version 3.0: several episodes in one table and in one video, or the images in the table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    info = _info("v3.0", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", names, images)
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    _write_json(folder / "meta/info.json", info)
    parts = np.array_split(np.arange(COUNT), 3)
    episodes = [episode for episode, numbers in enumerate(parts) for _ in numbers]
    within = [index for numbers in parts for index in range(len(numbers))]
    _table(folder / "data/chunk-000/file-000.parquet", np.arange(COUNT), episodes, within, images)
    if images == "video":
        _video(folder / f"videos/{CAMERA}/chunk-000/file-000.mp4", np.arange(COUNT))
    starts = [int(numbers[0]) / FPS for numbers in parts]
    rows: dict[str, list[Any]] = {"episode_index": [0, 1, 2], f"videos/{CAMERA}/from_timestamp": starts}
    rows |= {f"videos/{CAMERA}/{key}": [0, 0, 0] for key in ("chunk_index", "file_index")}
    file = folder / "meta/episodes/chunk-000/file-000.parquet"
    file.parent.mkdir(parents=True)
    pq.write_table(pa.table(rows), file)
    return folder


def _info(version: str, data_path: str, names: Sequence[str], images: str = "video") -> dict[str, Any]:
    features: dict[str, Any] = {
        CAMERA: {"dtype": images, "shape": [48, 64, 3], "names": ["height", "width", "channels"]}
    }
    features["action"] = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    return {
        "codebase_version": version,
        "robot_type": "racer",
        "fps": FPS,
        "chunks_size": 1000,
        "data_path": data_path,
        "features": features,
    }


def _write_json(file: Path, data: object) -> None:
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps(data))


def _table(
    file: Path, numbers: np.ndarray, episodes: list[int], within: list[int], images: str = "video"
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"action": pa.array([[value(int(k)), 0.4] for k in numbers], pa.list_(pa.float32(), 2))}
    columns |= {
        "timestamp": pa.array([index / FPS for index in within], pa.float32()),
        "episode_index": pa.array(episodes),
    }
    if images == "image":
        contents = [cv2.imencode(".png", picture(int(k)))[1].tobytes() for k in numbers]
        columns[CAMERA] = pa.array([{"bytes": content, "path": "a.png"} for content in contents])
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), file)


def _video(file: Path, numbers: np.ndarray) -> None:
    import av

    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=FPS, options={"q:v": "2"})
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        for k in numbers:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(int(k)), format="rgb24")))
        container.mux(stream.encode(None))
