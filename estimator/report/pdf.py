"""The report as PDF: the same document as the HTML on A4, figures as vectors, the same bytes each time."""

import io
from functools import partial
from html import escape
from pathlib import Path as FilePath

import matplotlib
from reportlab.lib import colors
from reportlab.lib.enums import TA_LEFT, TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    BaseDocTemplate,
    CondPageBreak,
    Flowable,
    KeepTogether,
    PageBreak,
    SimpleDocTemplate,
    Spacer,
)
from reportlab.platypus import Paragraph as Text
from reportlab.platypus import Table as Grid

from .blocks import Banner, Block, Document, Drawing, Gallery, Heading, Paragraph, Table
from .pdf_figure import FONT, FigureFlowable

MARGIN = 16 * mm
FRAME = A4[0] - 2 * MARGIN
ROWS_TOGETHER = 16
"""Tables up to this length are not torn apart."""
FACES = {"": "STIXGeneral.ttf", "-Bold": "STIXGeneralBol.ttf", "-Italic": "STIXGeneralItalic.ttf"}
"""The fonts that come with matplotlib under the SIL Open Font License."""


def render_pdf(document: Document) -> bytes:
    """The document as the bytes of a PDF file. Set twice: the first pass counts the pages."""
    _register_fonts()
    _, pages = _set(document, None)
    return _set(document, pages)[0]


def _set(document: Document, pages: int | None) -> tuple[bytes, int]:
    """The file and its number of pages."""
    story: list[Flowable] = _header(document)
    for block in document.blocks:
        story += _flowables(block)
    stream = io.BytesIO()
    template = SimpleDocTemplate(
        stream,
        pagesize=A4,
        leftMargin=MARGIN - 6,
        rightMargin=MARGIN - 6,
        topMargin=15 * mm,
        bottomMargin=17 * mm,
        title=document.title,
        author="surecut",
        subject=document.footer,
        invariant=True,
    )
    foot = partial(_footer, text=document.footer, pages=pages)
    template.build(_keep_headings(story), onFirstPage=foot, onLaterPages=foot)
    return stream.getvalue(), template.page


def _footer(canvas: Canvas, template: BaseDocTemplate, text: str, pages: int | None) -> None:
    canvas.setFont(FONT, 8)
    canvas.drawString(MARGIN, 10 * mm, text)
    canvas.drawRightString(A4[0] - MARGIN, 10 * mm, f"{template.page} of {pages}")


class _Together(KeepTogether):
    """Flowables that stay on one page, and can still be told apart."""

    def __init__(self, parts: list[Flowable]) -> None:
        super().__init__(parts)
        self.parts = parts


class _Heading(Text):
    """Told apart for the page breaks."""


class _Caption(Text):
    """Told apart for the page breaks."""


def _text(
    text: str,
    size: float,
    face: str = "",
    right: bool = False,
    before: float = 0,
    after: float = 0,
    kind: type[Text] = Text,
) -> Text:
    """One paragraph of plain text."""
    style = ParagraphStyle(
        f"{size}{face}{right}{before}{after}",
        fontName=FONT + face,
        fontSize=size,
        leading=round(1.24 * size, 1),
        alignment=TA_RIGHT if right else TA_LEFT,
        spaceBefore=before,
        spaceAfter=after,
    )
    return kind(escape(text), style)


def _register_fonts() -> None:
    folder = FilePath(matplotlib.get_data_path()) / "fonts" / "ttf"
    for face, file in FACES.items():
        if FONT + face not in pdfmetrics.getRegisteredFontNames():
            pdfmetrics.registerFont(TTFont(FONT + face, folder / file))


def _header(document: Document) -> list[Flowable]:
    cells = [[_text(document.title, 15), _text(document.subtitle, 9, right=True)]]
    rule = [("LINEABOVE", (0, 0), (-1, 0), 2.2, colors.black), ("LINEBELOW", (0, 0), (-1, 0), 0.6, colors.black)]
    layout = [("VALIGN", (0, 0), (-1, -1), "BOTTOM"), ("LEFTPADDING", (0, 0), (-1, -1), 0)]
    grid = Grid(cells, [FRAME * 0.6, FRAME * 0.4], style=[*rule, *layout, ("RIGHTPADDING", (0, 0), (-1, -1), 0)])
    return [grid, Spacer(1, 8)]


def _flowables(block: Block) -> list[Flowable]:
    match block:
        case Heading():
            size = 13 if block.level == 1 else 10.5
            heading = _text(block.text, size, "-Bold", before=8, after=3, kind=_Heading)
            return [PageBreak(), heading] if block.new_page else [heading]
        case Paragraph():
            return [_text(block.text, 9 if block.note else 10, after=4)]
        case Banner():
            return [_banner(block), Spacer(1, 6)]
        case Table():
            return _table(block)
        case Drawing():
            return [_drawing(block)]
        case Gallery():
            return _gallery(block)


def _drawing(drawing: Drawing, width: float = FRAME) -> Flowable:
    figure = FigureFlowable(drawing.figure, width)
    return _Together([figure, _text(drawing.caption, 8.5, before=2, after=5)])


def _gallery(gallery: Gallery) -> list[Flowable]:
    half = FRAME / 2 - 6
    cells: list[Flowable | str] = [_cell(drawing, half) for drawing in gallery.drawings]
    rows = [[*cells[i : i + 2], *[""] * (2 - len(cells[i : i + 2]))] for i in range(0, len(cells), 2)]
    layout = [("VALIGN", (0, 0), (-1, -1), "TOP"), ("LEFTPADDING", (0, 0), (-1, -1), 0)]
    return [Grid(rows, [FRAME / 2, FRAME / 2], style=layout)] if rows else []


def _cell(drawing: Drawing, width: float) -> Flowable:
    caption = _text(drawing.caption, 8.5)
    layout = [("LEFTPADDING", (0, 0), (-1, -1), 0), ("TOPPADDING", (0, 0), (-1, -1), 1)]
    return Grid([[FigureFlowable(drawing.figure, width)], [caption]], [width], style=layout)


def _banner(banner: Banner) -> Flowable:
    inner = FRAME - 76
    body: list[Flowable] = [
        _text(banner.word, 18, "-Bold"),
        _text(banner.headline, 11, after=4),
    ]
    if banner.figures:
        names = [_text(name, 8, "-Italic") for name, _ in banner.figures]
        values = [_text(value, 11.5, "-Bold") for _, value in banner.figures]
        rules = [(side, (0, row), (-1, row), 0.4, colors.grey) for side, row in (("LINEABOVE", 0), ("LINEBELOW", 1))]
        tight = [
            ("LEFTPADDING", (0, 0), (-1, -1), 0),
            ("TOPPADDING", (0, 0), (-1, -1), 2),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 1),
        ]
        body += [Grid([names, values], [inner / len(names)] * len(names), style=[*rules, *tight]), Spacer(1, 3)]
    body += [_text(f"•  {detail}", 9) for detail in banner.details]
    layout = [
        ("BOX", (0, 0), (-1, -1), 1.5, colors.black),
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("TOPPADDING", (0, 0), (-1, -1), 8),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 8),
        ("LEFTPADDING", (0, 0), (-1, -1), 10),
    ]
    return Grid([[FigureFlowable(banner.sign, 40), body]], [58, FRAME - 58], style=layout)


def _table(table: Table) -> list[Flowable]:
    def cell(text: str, column: int, face: str) -> Text:
        return _text(text, 9, face, right=column in table.numeric)

    rows = [[cell(text, i, "") for i, text in enumerate(row)] for row in table.rows[: len(table.rows) - table.total]]
    foot = [
        [cell(text, i, "-Bold") for i, text in enumerate(row)] for row in table.rows[len(table.rows) - table.total :]
    ]
    head = [[cell(text, i, "-Italic") for i, text in enumerate(table.header)]] if any(table.header) else []
    columns = len(table.header)
    shares = table.widths or (1 / columns,) * columns
    layout = [
        ("LINEBELOW", (0, 0), (-1, -1), 0.3, colors.Color(0.8, 0.8, 0.8)),
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("TOPPADDING", (0, 0), (-1, -1), 1.5),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
        ("LEFTPADDING", (0, 0), (-1, -1), 0),
        ("RIGHTPADDING", (0, 0), (-2, -1), 6),
        ("RIGHTPADDING", (-1, 0), (-1, -1), 0),
    ]
    if head:
        layout += [("LINEBELOW", (0, 0), (-1, 0), 0.6, colors.black), ("VALIGN", (0, 0), (-1, 0), "BOTTOM")]
    if foot:
        layout += [("LINEABOVE", (0, -len(foot)), (-1, -len(foot)), 0.6, colors.black)]
        layout += [("LINEBELOW", (0, -1), (-1, -1), 0.6, colors.black)]
    caption = _text(table.caption, 8.5, before=3, after=2, kind=_Caption)
    content = [*head, *rows, *foot]
    if not content:
        return [caption]
    grid = Grid(content, [share * FRAME for share in shares], style=layout, repeatRows=len(head))
    if len(content) <= ROWS_TOGETHER:
        return [_Together([caption, grid]), Spacer(1, 6)]
    return [caption, grid, Spacer(1, 6)]


def _keep_headings(story: list[Flowable]) -> list[Flowable]:
    """Headings stay with what follows: with a figure or short table as a whole, else with its first lines."""
    kept: list[Flowable] = []
    for flowable in story:
        last = kept[-1] if kept else None
        if isinstance(flowable, _Together) and isinstance(last, _Heading):
            kept[-1] = _Together([last, *flowable.parts])
            continue
        if isinstance(flowable, _Heading) and not isinstance(last, PageBreak | _Heading):
            kept.append(CondPageBreak(32 * mm))
        elif isinstance(flowable, PageBreak) and isinstance(last, Spacer):
            kept.pop()  # on a full page it would go to a page of its own
        elif isinstance(flowable, _Caption):
            kept.append(CondPageBreak(18 * mm))
        kept.append(flowable)
    return kept
