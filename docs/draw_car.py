"""Draws the car of docs/wiring.md: ``python docs/draw_car.py`` writes ``docs/car_wiring.svg`` and ``docs/car_markers.svg``.

Distances between axles, camera and markers are to scale; boxes and wires show what is connected with what.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

from advnerf_core.files import write_atomically
from calibration.schema import CameraCalibration, VehicleCalibration, load_calibration

ROOT = Path(__file__).resolve().parents[1]
_TWIN = ROOT / "calibration" / "twin"
_INK, _MUTED, _PAPER, _BOX = "#1f2933", "#59626d", "#ffffff", "#f1f4f7"
_POWER, _DATA, _MARKER = "#b0123c", "#0b6bb8", "#8a5a00"
# Seen from above, in metres from the point under the rear axle: x forward, y left. No symmetry maps these onto one another.
MARKERS_M = ((-0.07, 0.12), (0.11, -0.12), (0.29, 0.07), (0.31, -0.11), (0.15, 0.12))
_BODY_M = ((-0.10, -0.146), (0.38, 0.146))
_PX_PER_M = 1000.0


def text(x: float, y: float, words: str, size: int = 13, anchor: str = "middle", colour: str = _INK) -> str:
    """A line of text."""
    style = f'font-family="sans-serif" font-size="{size}" fill="{colour}" text-anchor="{anchor}"'
    return f'<text x="{x:g}" y="{y:g}" {style}>{escape(words)}</text>'


def box(x: float, y: float, width: float, height: float, *lines: str) -> str:
    """A device: its name, and facts in smaller type."""
    first = y + height / 2 - 8 * (len(lines) - 1) + 4
    rows = [
        text(x + width / 2, first + 16 * k, line, 13 if k == 0 else 11, colour=_INK if k == 0 else _MUTED)
        for k, line in enumerate(lines)
    ]
    frame = f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6" fill="{_BOX}" stroke="{_INK}"/>'
    return "".join((frame, *rows))


def wire(colour: str, *points: tuple[float, float], dash: str = "") -> str:
    """A cable through points; a dashed one is no cable."""
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2.5" stroke-dasharray="{dash}"/>'


def svg(width: int, height: int, *parts: str) -> str:
    """A picture on white, which is read in both themes."""
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    paper = f'<rect width="{width}" height="{height}" fill="{_PAPER}"/>'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{paper}\n' + "\n".join(parts) + "\n</svg>\n"


def wiring() -> str:
    """Power and data of a car, and the room's network."""
    power = [
        wire(_POWER, (170, 75), (330, 75)),
        wire(_POWER, (500, 75), (640, 75)),
        text(570, 66, "three phases", 11, colour=_POWER),
        wire(_POWER, (170, 235), (330, 235)),
        # The switch stands open: who works at the car has taken the motor's power away.
        f'<circle cx="228" cy="75" r="5" fill="{_PAPER}" stroke="{_POWER}" stroke-width="2.5"/>',
        f'<circle cx="272" cy="75" r="5" fill="{_PAPER}" stroke="{_POWER}" stroke-width="2.5"/>',
        f'<rect x="233.5" y="70" width="33" height="10" fill="{_PAPER}"/>',
        wire(_POWER, (231, 71), (264, 52)),
        text(250, 40, "switch, within reach", 11, colour=_POWER),
    ]
    data = [
        wire(_DATA, (460, 110), (460, 150), (640, 150)),
        text(550, 142, "servo plug (PWM)", 11, colour=_DATA),
        wire(_DATA, (390, 110), (390, 200)),
        text(382, 160, "USB, data only", 11, "end", _DATA),
        wire(_DATA, (500, 220), (640, 220)),
        text(570, 212, "USB 3", 11, colour=_DATA),
        wire(_DATA, (415, 270), (415, 335), dash="7 5"),
        text(425, 306, "Ethernet or 5 GHz Wi-Fi", 11, "start", _DATA),
        wire(_DATA, (330, 360), (170, 360)),
        wire(_DATA, (500, 360), (640, 360)),
    ]
    devices = [
        box(20, 45, 150, 60, "motor battery"),
        box(330, 40, 170, 70, "VESC", "powered by the motor battery", "timeout 250 ms, 20 A"),
        box(640, 45, 150, 60, "motor"),
        box(640, 125, 150, 50, "steering servo"),
        box(20, 205, 150, 60, "computer battery"),
        box(330, 200, 170, 70, "companion computer", "safety, motor and", "camera nodes"),
        box(640, 195, 150, 50, "camera"),
        box(20, 335, 150, 50, "workstation"),
        box(330, 335, 170, 50, "network switch"),
        box(640, 335, 150, 50, "Tracker computer", "UDP port 51001"),
        f'<rect x="8" y="12" width="794" height="270" rx="10" fill="none" stroke="{_MUTED}" stroke-dasharray="3 5"/>',
        text(790, 272, "on the car", 12, "end", _MUTED),
    ]
    return svg(810, 400, *power, *data, *devices)


def markers() -> str:
    """A motion-capture subject of the car, from above."""
    wheelbase_m = load_calibration(VehicleCalibration, _TWIN / "vehicle.yaml").wheelbase_m
    camera_m = load_calibration(CameraCalibration, _TWIN / "camera.yaml").T_car_from_camera[0][3]

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        return 170 + x_m * _PX_PER_M, 200 - y_m * _PX_PER_M

    (left, bottom), (right, top) = at(*_BODY_M[0]), at(*_BODY_M[1])
    body = f'<rect x="{left:g}" y="{top:g}" width="{right - left:g}" height="{bottom - top:g}" rx="18" fill="{_BOX}" stroke="{_INK}"/>'
    wheels = [
        f'<rect x="{at(x_m, 0)[0] - 32:g}" y="{at(0, y_m)[1] - 13:g}" width="64" height="26" rx="5" fill="{_MUTED}"/>'
        for x_m in (0.0, wheelbase_m)
        for y_m in (0.1275, -0.1275)
    ]
    axle = [wire(_MUTED, at(x_m, 0.1275), at(x_m, -0.1275)) for x_m in (0.0, wheelbase_m)]
    balls = []
    for number, (x_m, y_m) in enumerate(MARKERS_M, 1):
        x, y = at(x_m, y_m)
        balls.append(
            f'<circle cx="{x:g}" cy="{y:g}" r="9" fill="#ffd479" stroke="{_MARKER}" stroke-width="2.5"/>'
        )
        balls.append(text(x + 13, y + 5, str(number), 12, "start", _MARKER))
    pairs = [(a, b) for k, a in enumerate(MARKERS_M) for b in MARKERS_M[k + 1 :]]
    sides = [
        f'<line x1="{at(*a)[0]:g}" y1="{at(*a)[1]:g}" x2="{at(*b)[0]:g}" y2="{at(*b)[1]:g}" stroke="{_MARKER}" stroke-opacity="0.35"/>'
        for a, b in pairs
    ]
    x, y = at(0.0, 0.0)
    arrows = [
        wire(_POWER, (x, y), (x + 95, y)),
        f'<path d="M{x + 106:g},{y:g} l-14,-6 v12 z" fill="{_POWER}"/>',
        text(x + 92, y + 20, "x forward", 12, colour=_POWER),
        wire(_DATA, (x, y), (x, y - 75)),
        f'<path d="M{x:g},{y - 86:g} l-6,14 h12 z" fill="{_DATA}"/>',
        text(x + 10, y - 66, "y left", 12, "start", _DATA),
        f'<circle cx="{x:g}" cy="{y:g}" r="6" fill="{_PAPER}" stroke="{_INK}" stroke-width="2.5"/>',
    ]
    lens_x, lens_y = at(camera_m, 0.0)
    camera = f'<rect x="{lens_x - 8:g}" y="{lens_y - 28:g}" width="16" height="56" rx="4" fill="{_INK}"/>'
    notes = [
        text(x, 380, "origin: on the floor, under the middle of the rear axle", 12, "start"),
        wire(_MUTED, (x, y + 8), (x, 366), dash="3 4"),
        text(lens_x + 14, lens_y + 5, "camera", 12, "start"),
        text(
            20,
            24,
            "subject car, from above: five markers, all distances different, at different heights",
            13,
            "start",
        ),
    ]
    return svg(640, 400, body, *axle, *wheels, *sides, *arrows, camera, *balls, *notes)


def written() -> dict[Path, str]:
    """The pictures by their files."""
    return {ROOT / "docs" / "car_wiring.svg": wiring(), ROOT / "docs" / "car_markers.svg": markers()}


if __name__ == "__main__":
    for file, content in written().items():
        write_atomically(file, content)
        print(f"{file.relative_to(ROOT)}: {len(content) / 1e3:.0f} kB")
