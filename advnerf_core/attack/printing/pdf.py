"""A PDF of lines, texts and pictures with exact dimensions, whose pictures keep every pixel.

Plotting libraries hold all pictures of a document in memory until it is closed; a board in tiles is gigabytes. Here a page is
compressed when it is added.

Source: ISO 32000-1:2008; sections are given in the code.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

_POINTS_PER_MM = 72.0 / 25.4
_FONTS = ("Helvetica", "Helvetica-Bold")  # built into every reader (9.6.2.2): nothing to embed
_CATALOG, _PAGES, _FIRST_FONT = 1, 2, 3


class Page:
    """Content of a page, in millimetres from its upper left corner, y down.

    Args:
        size_mm: Width and height.
        trim_mm: Left, top, width and height of what remains when it is cut; None for the whole page.
    """

    def __init__(
        self, size_mm: tuple[float, float], trim_mm: tuple[float, float, float, float] | None = None
    ) -> None:
        self.size_mm = size_mm
        self.trim_mm = trim_mm or (0.0, 0.0, *size_mm)
        self.images: list[NDArray[np.uint8]] = []
        self.drawn = [
            f"{_n(_POINTS_PER_MM)} 0 0 {_n(-_POINTS_PER_MM)} 0 {_n(size_mm[1] * _POINTS_PER_MM)} cm"
        ]

    def line(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        width_mm: float = 0.1,
        dashed: bool = False,
    ) -> None:
        """Draw a black line."""
        dash = "[0.6 0.4] 0 d" if dashed else "[] 0 d"
        a, b = (" ".join(map(_n, point)) for point in (start, end))
        self.drawn.append(f"{dash} {_n(width_mm)} w {a} m {b} l S")

    def box(
        self,
        corner: tuple[float, float],
        size_mm: tuple[float, float],
        fill: tuple[int, int, int] | None = None,
    ) -> None:
        """Draw the thin outline of a rectangle from its upper left corner, filled with an sRGB colour (0..255)."""
        colour = "" if fill is None else " ".join(_n(each / 255.0) for each in fill) + " rg "
        where = " ".join(map(_n, (*corner, *size_mm)))
        self.drawn.append(f"q {colour}[] 0 d 0.1 w {where} re {'S' if fill is None else 'B'} Q")

    def text(self, start: tuple[float, float], text: str, size_pt: float = 9.0, bold: bool = False) -> None:
        """Write a line of text from the left end of its baseline."""
        size = size_pt / _POINTS_PER_MM
        data = (
            text.encode("cp1252", "replace")
            .replace(b"\\", b"\\\\")
            .replace(b"(", b"\\(")
            .replace(b")", b"\\)")
        )
        x, y = map(_n, start)
        # Read back as Latin-1, byte for byte: the page is joined as text.
        self.drawn.append(
            f"BT /F{int(bold)} {_n(size)} Tf 1 0 0 -1 {x} {y} Tm ({data.decode('latin-1')}) Tj ET"
        )

    def image(
        self, corner: tuple[float, float], size_mm: tuple[float, float], rgb: NDArray[np.uint8]
    ) -> None:
        """Draw a picture ``[h, w, 3]`` with its upper left corner here."""
        x, y, (width, height) = _n(corner[0]), _n(corner[1] + size_mm[1]), map(_n, size_mm)
        self.drawn.append(f"q {width} 0 0 -{height} {x} {y} cm /I{len(self.images)} Do Q")
        self.images.append(rgb)


class PdfDocument:
    """Pages in order.

    Args:
        title: Title of the reader's window.
    """

    def __init__(self, title: str) -> None:
        self._objects: dict[int, bytes] = {}
        self._pages: list[int] = []
        for number, font in enumerate(_FONTS):
            self._objects[_FIRST_FONT + number] = (
                f"<< /Type /Font /Subtype /Type1 /BaseFont /{font} /Encoding /WinAnsiEncoding >>".encode()
            )
        self._info = self._put(f"<< /Title <{title.encode('ascii', 'replace').hex()}> >>".encode())

    def add(self, page: Page) -> None:
        """Add a page; its pictures are compressed now."""
        images = [self._put(_image(rgb)) for rgb in page.images]
        content = self._put(_stream("", "\n".join(page.drawn).encode("latin-1")))
        pictures = " ".join(f"/I{k} {number} 0 R" for k, number in enumerate(images))
        fonts = " ".join(f"/F{k} {_FIRST_FONT + k} 0 R" for k in range(len(_FONTS)))
        width, height = (each * _POINTS_PER_MM for each in page.size_mm)
        left, top, across, down = (each * _POINTS_PER_MM for each in page.trim_mm)
        trim = " ".join(map(_n, (left, height - top - down, left + across, height - top)))
        self._pages.append(
            self._put(
                f"<< /Type /Page /Parent {_PAGES} 0 R /MediaBox [0 0 {_n(width)} {_n(height)}] /TrimBox [{trim}] "
                f"/Resources << /Font << {fonts} >> /XObject << {pictures} >> >> /Contents {content} 0 R >>".encode()
            )
        )

    def to_bytes(self) -> bytes:
        """The whole file: objects, and the table of where each begins (7.5.4)."""
        # Print dialogues begin with no scaling (12.2).
        preferences = "/ViewerPreferences << /PrintScaling /None /DisplayDocTitle true >>"
        kids = " ".join(f"{number} 0 R" for number in self._pages)
        objects = {
            **self._objects,
            _CATALOG: f"<< /Type /Catalog /Pages {_PAGES} 0 R {preferences} >>".encode(),
            _PAGES: f"<< /Type /Pages /Kids [{kids}] /Count {len(self._pages)} >>".encode(),
        }
        parts, table = [b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n"], [b"0000000000 65535 f \n"]
        position = len(parts[0])
        for number in sorted(objects):
            parts.append(b"%d 0 obj\n" % number + objects[number] + b"\nendobj\n")
            table.append(b"%010d 00000 n \n" % position)
            position += len(parts[-1])
        trailer = f"trailer\n<< /Size {len(table)} /Root {_CATALOG} 0 R /Info {self._info} 0 R >>\nstartxref\n{position}\n%%EOF\n"
        return b"".join([*parts, b"xref\n0 %d\n" % len(table), *table, trailer.encode()])

    def _put(self, content: bytes) -> int:
        number = max(self._objects) + 1
        self._objects[number] = content
        return number


def _image(rgb: NDArray[np.uint8]) -> bytes:
    """A picture ``[h, w, 3]`` as an object, each row as its difference from the one above (7.4.4.4), which smooth pictures have little of."""
    height, width = rgb.shape[:2]
    rows = np.full((height, 1 + 3 * width), 2, np.uint8)  # each row begins with the number of its predictor
    flat = rgb.reshape(height, -1)
    rows[0, 1:] = flat[0]
    np.subtract(flat[1:], flat[:-1], out=rows[1:, 1:])
    about = (
        f"/Type /XObject /Subtype /Image /Width {width} /Height {height} /ColorSpace /DeviceRGB /BitsPerComponent 8 "
        f"/Filter /FlateDecode /DecodeParms << /Predictor 15 /Colors 3 /Columns {width} >> "
    )
    return _stream(about, zlib.compress(rows.data, 6))


def _stream(about: str, data: bytes) -> bytes:
    return f"<< {about}/Length {len(data)} >>\nstream\n".encode() + data + b"\nendstream"


def _n(value: float) -> str:
    """A number as PDF writes it, without an exponent."""
    return f"{value:.6f}".rstrip("0").rstrip(".")
