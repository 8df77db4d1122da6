"""What a report is made of, whatever it is printed on."""

from dataclasses import dataclass

from ..decision import Verdict
from .figure import Figure


@dataclass(frozen=True, slots=True)
class Heading:
    text: str
    level: int = 2
    new_page: bool = False


@dataclass(frozen=True, slots=True)
class Paragraph:
    text: str
    note: bool = False
    """Smaller, for explanations."""


@dataclass(frozen=True, slots=True)
class Banner:
    """The verdict of one cut."""

    point: str
    verdict: Verdict | None
    """None: no cut plan asks for one."""
    word: str
    headline: str
    figures: tuple[tuple[str, str], ...]
    """Key figures: what, and its value."""
    details: tuple[str, ...]
    sign: Figure


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text; numeric columns are set flush right."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[int, ...] = ()
    total: int = 0
    """Number of rows at the end that sum up."""
    widths: tuple[float, ...] = ()
    """Shares of the width; none: even."""


@dataclass(frozen=True, slots=True)
class Drawing:
    figure: Figure
    caption: str


@dataclass(frozen=True, slots=True)
class Gallery:
    """Figures side by side."""

    drawings: tuple[Drawing, ...]


Block = Heading | Paragraph | Banner | Table | Drawing | Gallery


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    footer: str
    """One line that names the data: goes on every page."""
    blocks: tuple[Block, ...]
