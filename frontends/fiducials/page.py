"""A printable page of markers at exact size: the layout, and its drawing as SVG and PDF. Millimetres on paper."""

from dataclasses import dataclass
from html import escape
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ...factors.errors import RigError
from ...factors.rig import Board, Marker
from .dictionaries import marker_dictionary

PAPERS_MM = {
    "A0": (841.0, 1189.0),
    "A1": (594.0, 841.0),
    "A2": (420.0, 594.0),
    "A3": (297.0, 420.0),
    "A4": (210.0, 297.0),
    "A5": (148.0, 210.0),
    "LETTER": (215.9, 279.4),
    "LEGAL": (215.9, 355.6),
    "TABLOID": (279.4, 431.8),
}
RULER_MM = 100.0
_STRIP_MM = 16.0
"""Height at the bottom of the page that the ruler and the text take."""
_PRINTER_MARGIN_MM = 8.0
_POINTS_PER_MM = 72.0 / 25.4
_TEXT_MM = 2.6

Rectangle = tuple[float, float, float, float]
"""x, y of the upper left corner, width, height; millimetres from the upper left corner of the page."""


@dataclass(frozen=True, slots=True)
class Page:
    """What is printed where."""

    size_mm: tuple[float, float]
    board: Board
    black: tuple[Rectangle, ...]
    """Cells of the markers, runs along a row joined."""
    ruler: tuple[Rectangle, ...]
    texts: tuple[tuple[float, float, str], ...]
    """x, y of the base line, text."""


def lay_out(
    dictionary: str, ids: tuple[int, ...], side_mm: float, size_mm: tuple[float, float], board_id: str = "f0"
) -> Page:
    """Markers in rows and columns as far apart as the page allows, from the upper left one, with a ruler below.

    A white rim of a cell round each marker is kept: without it no detector finds the border.

    Raises:
        RigError: the dictionary or an id does not exist, an id stands twice, or the markers do not fit.
    """
    known = marker_dictionary(dictionary)
    beyond = [i for i in ids if not 0 <= i < known.size]
    if beyond:
        raise RigError(f"{known.name} has ids 0 to {known.size - 1}; {beyond[0]} is none of them")
    if not ids or len(set(ids)) < len(ids):
        raise RigError("a page needs at least one marker, and each id once")
    rim = max(side_mm / known.cells, _PRINTER_MARGIN_MM)
    area = size_mm[0] - 2 * rim, size_mm[1] - _STRIP_MM - 2 * rim
    columns, rows = _grid(len(ids), side_mm, side_mm / known.cells, area)
    x = _spread(columns, area[0], side_mm, rim)
    y = _spread(rows, area[1], side_mm, rim)
    places = [(x[k % columns], y[k // columns]) for k in range(len(ids))]
    markers = tuple(
        Marker(id=i, centre_m=_page_frame(left + side_mm / 2, top + side_mm / 2, size_mm))
        for i, (left, top) in zip(ids, places, strict=True)
    )
    board = Board(id=board_id, dictionary=known.name, side_m=round(side_mm / 1000, 9), markers=markers)
    black = tuple(
        cell
        for i, place in zip(ids, places, strict=True)
        for cell in _black_cells(known.pattern(i), *place, side_mm / known.cells)
    )
    ruler, texts = _foot(board, side_mm, size_mm)
    return Page(size_mm, board, black, ruler, texts)


def _page_frame(x_mm: float, y_mm: float, size_mm: tuple[float, float]) -> tuple[float, float]:
    """Metres in {f}: origin at the page's centre, y up."""
    return round((x_mm - size_mm[0] / 2) / 1000, 9), round((size_mm[1] / 2 - y_mm) / 1000, 9)


def _grid(count: int, side: float, cell: float, area: tuple[float, float]) -> tuple[int, int]:
    """Columns and rows with the largest gap between markers."""
    best: tuple[float, int, int] | None = None
    for columns, rows in product(range(1, count + 1), repeat=2):
        if columns * rows < count or (columns - 1) * rows >= count or columns * (rows - 1) >= count:
            continue
        gaps = [(length - n * side) / max(n - 1, 1) for n, length in ((columns, area[0]), (rows, area[1]))]
        enough = all(gap >= (2 * cell if n > 1 else 0.0) - 1e-9 for gap, n in zip(gaps, (columns, rows), strict=True))
        smallest = min([gap for gap, n in zip(gaps, (columns, rows), strict=True) if n > 1], default=0.0)
        if enough and (best is None or smallest > best[0]):
            best = smallest, columns, rows
    if best is None:
        raise RigError(
            f"{count} markers of {side:g} mm do not fit on the page ({area[0]:.0f} x {area[1]:.0f} mm within margins); "
            "take a smaller side, fewer ids or a larger page"
        )
    return best[1], best[2]


def _spread(count: int, length: float, side: float, rim: float) -> list[float]:
    if count == 1:
        return [rim + (length - side) / 2]
    return [rim + k * (length - side) / (count - 1) for k in range(count)]


def _black_cells(pattern: NDArray[np.float64], left: float, top: float, cell: float) -> list[Rectangle]:
    rectangles = []
    for row, line in enumerate(pattern.T[::-1] < 0.5):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            rectangles.append((left + start * cell, top + row * cell, (end - start) * cell, cell))
    return rectangles


def _foot(
    board: Board, side_mm: float, size_mm: tuple[float, float]
) -> tuple[tuple[Rectangle, ...], tuple[tuple[float, float, str], ...]]:
    """The ruler and what stands beside it."""
    width, height = size_mm
    x, y = _PRINTER_MARGIN_MM, height - _PRINTER_MARGIN_MM
    length = RULER_MM if width >= RULER_MM + 2 * _PRINTER_MARGIN_MM else 50.0
    line = 0.2
    ticks = [
        (x + at - line / 2, y - tall, line, tall)
        for at in np.arange(0.0, length + 0.5, 1.0)
        for tall in [4.0 if at % 10 == 0 else 3.0 if at % 5 == 0 else 2.0]
    ]
    # a wide page has room beside the ruler, a narrow one above it
    beside = width - x - length > 110.0
    text_x, text_y = (x + length + 6.0, y) if beside else (x, y - 5.2)
    ids = ", ".join(str(marker.id) for marker in board.markers)
    texts = (
        (text_x, text_y, f"surecut board {board.id}: {board.dictionary}, ids {ids}, side {side_mm:g} mm, "
         f"page {width:g} x {height:g} mm"),
        (text_x, text_y - 3.4, f"Print at 100 %, not fitted to the page: the ruler must measure {length:g} mm."),
    )  # fmt: skip
    return ((x, y - line / 2, length, line), *((t[0], t[1], t[2], t[3]) for t in ticks)), texts


def as_svg(page: Page) -> str:
    """The page as SVG in millimetres."""
    width, height = page.size_mm
    cells = "".join(f"M{x:.4f} {y:.4f}h{w:.4f}v{h:.4f}h{-w:.4f}z" for x, y, w, h in page.black)
    ruler = "".join(f"M{x:.4f} {y:.4f}h{w:.4f}v{h:.4f}h{-w:.4f}z" for x, y, w, h in page.ruler)
    texts = "".join(
        f'<text x="{x:.2f}" y="{y:.2f}" font-family="Helvetica, Arial, sans-serif" font-size="{_TEXT_MM}">'
        f"{escape(text)}</text>\n"
        for x, y, text in page.texts
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">\n'
        f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>\n'
        f'<path id="markers" d="{cells}"/>\n<path id="ruler" d="{ruler}"/>\n{texts}</svg>\n'
    )


def as_pdf(page: Page) -> bytes:
    """The page as a PDF of one page: all cells in one filled path, so that no renderer leaves seams between them."""
    width, height = (side * _POINTS_PER_MM for side in page.size_mm)
    scale = f"{_POINTS_PER_MM:.8f} 0 0 {-_POINTS_PER_MM:.8f} 0 {height:.6f} cm"
    draw = ["q", scale]
    draw += [f"{x:.4f} {y:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in page.black] + ["f"]
    draw += [f"{x:.4f} {y:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in page.ruler] + ["f", "Q"]
    for x, y, text in page.texts:
        plain = text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        at = f"{x * _POINTS_PER_MM:.3f} {height - y * _POINTS_PER_MM:.3f} Td"
        draw.append(f"BT /F1 {_TEXT_MM * _POINTS_PER_MM:.2f} Tf {at} ({plain}) Tj ET")
    content = "\n".join(draw).encode("latin-1", "replace")
    return _pdf_file(
        [
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 %.6f %.6f] /Contents 4 0 R "
            b"/Resources << /Font << /F1 5 0 R >> >> >>" % (width, height),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
    )


def _pdf_file(objects: list[bytes]) -> bytes:
    """Numbered objects with their table of places."""
    out, places = bytearray(b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n"), []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
    return bytes(out)
