"""The room as files: another program that reads them has the same scene, without the car."""

import numpy as np

from hardware.worlds.lab.config import LabConfig, RoomConfig
from hardware.worlds.lab.files import SCENE, room_as_files
from hardware.worlds.lab.gl import load_mujoco
from hardware.worlds.lab.world import build_model


def test_the_files_are_the_room_without_the_car():
    config = LabConfig(room=RoomConfig(seed=11))
    files = room_as_files(config)
    pictures = {name: data for name, data in files.items() if name != SCENE}
    read, built = (
        load_mujoco().MjModel.from_xml_string(files[SCENE].decode(), pictures),
        build_model(config),
    )
    assert read.nbody == built.nbody - 1
    solids = built.geom_bodyid == 0
    for name in ("geom_type", "geom_pos", "geom_quat", "geom_size", "geom_rgba", "geom_matid"):
        np.testing.assert_allclose(getattr(read, name), getattr(built, name)[solids], atol=1e-5, err_msg=name)
    for name in ("tex_data", "mesh_vert", "mesh_texcoord", "light_dir", "mat_emission"):
        np.testing.assert_allclose(getattr(read, name), getattr(built, name), atol=1e-5, err_msg=name)
