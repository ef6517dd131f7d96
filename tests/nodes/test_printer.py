"""A printer and a light from one photograph of a chart: against a printer whose inks are known, and on a print in the simulated lab."""

import json

import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.printing.poster import poster_of
from advnerf_core.attack.spaces.displayed import displayed
from advnerf_core.data.image_files import write_image
from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import invert_transform, look_at, make_transform, rotation_z
from calibration.by_construction import LAB_DATE
from calibration.display_colour import DisplayCalibration
from calibration.measured import LensCalibration
from calibration.print_chart import chart_record, fit_printer, make_chart, printer_calibration
from calibration.schema import load_calibration, save_calibration
from hardware.worlds.lab.lab import Lab
from hardware.worlds.world import Panel
from nodes.experiment.node.prepare import prepare
from nodes.experiment.node.search import run_attack
from nodes.runtime.progress import ProgressDisplay
from tests.support.commands import advnerf
from tests.support.photographed import before_camera, encoded, lens, photograph
from tests.support.printers import printed, printer_model
from tests.support.tiny_request import loaded, tiny_request

LENS = lens(960, 720, 750.0)
LIGHT = np.array([0.85, 0.75, 0.6])


def on_paper(sheet, dpi):
    """The linear reflectance of a printed sheet, and its size [m]."""
    width_mm, height_mm = sheet.sheet_mm
    size = (round(width_mm * dpi / 25.4), round(height_mm * dpi / 25.4))
    return printed(sheet.pixels((0.0, 0.0, width_mm, height_mm), size) / 255.0).astype(np.float32), (
        width_mm / 1000,
        height_mm / 1000,
    )


@pytest.fixture
def call(monkeypatch, capsys):
    def call(*arguments: object) -> tuple[object, str]:
        code, said = advnerf(monkeypatch, *arguments), capsys.readouterr()
        return code, " ".join((said.out + said.err).split())

    return call


def test_a_printer_whose_inks_are_known(call, tmp_path):
    assert call("car", "calibrate", "printer-chart", "-o", tmp_path / "chart.pdf")[0] == 0
    assert (tmp_path / "chart.pdf").read_bytes().count(b"/MediaBox [0 0 841.889764 595.275591]") == 1
    save_calibration(LENS, tmp_path / "lens.yaml")
    T, chart = before_camera(0.36, 12, 8, 2), on_paper(make_chart("a4"), 100.0)
    write_image(
        tmp_path / "photo.png",
        photograph([(chart, T)], LENS, light=LIGHT, slope=0.15, black=0.0),
    )
    command = (
        "car",
        "calibrate",
        "printer",
        tmp_path / "photo.png",
        "--chart",
        tmp_path / "chart.print.json",
        "--lens",
        tmp_path / "lens.yaml",
    )
    code, said = call(*command, "-o", tmp_path / "printer.yaml")
    assert code == 0, said
    assert "face: {display:" in said
    model = load_calibration(DisplayCalibration, tmp_path / "printer.yaml").display
    colours = np.random.default_rng(7).uniform(0.0, 1.0, (500, 3))
    error = model.forward(colours) - encoded(printed(colours) * LIGHT)
    assert np.sqrt(np.mean(error**2)) < 0.005
    assert np.abs(error).max() < 0.03
    seen = displayed(model, torch.from_numpy(colours)).numpy()
    assert seen == pytest.approx(model.forward(colours), abs=1e-9)
    again, clipped = model.inverse(seen)
    assert again == pytest.approx(colours, abs=1e-4)
    assert clipped == 0.0
    assert model.inverse([[0.0, 1.0, 0.0]])[1] == 1.0  # no ink is that green
    write_image(
        tmp_path / "photo.png",
        photograph([(chart, T)], LENS, light=3.0 * LIGHT, black=0.0),
    )
    code, said = call(*command, "-o", tmp_path / "no.yaml")
    assert code == 2
    assert "shorten the exposure" in said
    assert not (tmp_path / "no.yaml").exists()


@pytest.mark.parametrize("aspect", [0.98, 1.02])
def test_a_stretched_chart_gives_the_same_printer(aspect):
    """Its fields are not where the nominal ones are; read there, colours were up to 14 of 255 off."""
    sheet = make_chart("a4")
    pixels, (width_m, height_m) = on_paper(sheet, 100.0)
    picture = photograph(
        [((pixels, (aspect * width_m, height_m)), before_camera(0.36, 12, 8, 2))],
        LENS,
        light=LIGHT,
        black=0.0,
    )
    model = printer_calibration(fit_printer(picture, LENS, chart_record(sheet, 200.0)), "").display
    colours = np.random.default_rng(7).uniform(0.0, 1.0, (500, 3))
    error = model.forward(colours) - encoded(printed(colours) * LIGHT)
    assert np.abs(error).max() < 2.0 / 255.0


def test_search_print_hang_photograph_measure_and_drive_in_the_simulated_lab(call, tmp_path):
    request = tiny_request(tmp_path, evaluations=2)
    (file,) = run_attack(loaded(request), tmp_path / "run", ProgressDisplay())
    assert call("attack", "print", file, "-o", tmp_path / "p.png", "--dpi", 25)[0] == 0
    sheet = poster_of(load_attack(file)).with_markers()
    reflectance, (width_m, height_m) = on_paper(sheet, 25.0)
    scale = 0.97
    T = make_transform(rotation_z(3.0), [1.3, -1.6, 0.7])
    camera = np.array([0.05, -1.35, 0.75])
    with Lab() as lab:
        pinhole, texture = lab.photo_pinhole, np.round(255.0 * encoded(reflectance)).astype(np.uint8)
        lab.add_panel("print", Panel(T, scale * width_m, scale * height_m), texture)
        T_world_from_camera = look_at(camera, T[:3, 3])
        write_image(tmp_path / "photo.png", lab.photograph(T_world_from_camera))
    phone = LensCalibration(date=LAB_DATE, method="by construction", **vars(pinhole), rms_px=None)
    save_calibration(phone, tmp_path / "phone.yaml")
    code, said = call(
        "attack", "measure", tmp_path / "photo.png", "--print", tmp_path / "p.print.json", "--camera", tmp_path / "phone.yaml",
        "--distance", float(np.linalg.norm(camera - T[:3, 3])), "--request", request,
    )  # fmt: skip
    assert code == 0, said
    found = json.loads((tmp_path / "photo.measured.json").read_text())
    true = invert_transform(T_world_from_camera) @ T
    pose = np.array(found["T_camera_from_face"])
    assert found["size_m"] == pytest.approx(np.multiply(scale, sheet.size_m), rel=0.01)
    assert np.degrees(rotation_angles((pose[:3, :3].T @ true[:3, :3])[None])[0]) < 1.0
    assert pose[:3, 3] == pytest.approx(true[:3, 3], abs=0.01)
    # Inks are darker than the screen's colours, and the lamps and the phone's colours do not count.
    assert 3.0 < found["colours"]["rms"] < 60.0
    assert "if it hung at the attack's pose" in said
    assert found["effect"]["print_m"] > 0.0


def test_a_search_within_the_range_of_a_printer_sees_its_colours(call, tmp_path):
    request = tiny_request(tmp_path)
    model = printer_model()
    calibration = DisplayCalibration(date=LAB_DATE, method="computed", model=model.to_dict())
    save_calibration(calibration, tmp_path / "printer.yaml")
    request.write_text(request.read_text().replace("resolution: 8,", "resolution: 8, display: printer.yaml,"))
    prepared = prepare(loaded(request))
    theta = 5.0 * torch.randn(8, 8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    seen = torch.sigmoid(prepared.space.sensor.seen_theta(theta))
    assert seen.numpy() == pytest.approx(model.forward(torch.sigmoid(theta).numpy()), abs=1e-4)
    # No colour leaves the range of the inks: at most as light as paper, at least as dark as all inks together.
    assert model.forward([[0.0] * 3]).min() - 1e-4 < float(seen.min())
    assert float(seen.max()) < model.forward([[1.0] * 3]).max() + 1e-4
