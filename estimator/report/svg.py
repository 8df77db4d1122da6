"""A figure as inline SVG."""

import base64
from html import escape

from .figure import Figure, Label, Path, Picture, Stroke


def svg(figure: Figure) -> str:
    """The figure as one `<svg>` element that needs nothing from outside."""
    body = "".join(_stroke(stroke) for stroke in figure.strokes)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" viewBox="0 0 {_n(figure.width)} {_n(figure.height)}" '
        f'style="width:{_n(figure.width)}pt"><title>{escape(figure.title)}</title>{body}</svg>'
    )


def media_type(data: bytes) -> str:
    """`image/png` or `image/jpeg`."""
    return "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"


def _stroke(stroke: Stroke) -> str:
    if isinstance(stroke, Path):
        return _path(stroke)
    if isinstance(stroke, Label):
        return _label(stroke)
    return _picture(stroke)


def _path(path: Path) -> str:
    points = "L".join(f"{_n(x)} {_n(y)}" for x, y in path.points)
    fill = "none" if path.fill is None else _grey(path.fill)
    dash = f' stroke-dasharray="{" ".join(_n(d) for d in path.dash)}"' if path.dash else ""
    stroke = f'stroke="{_grey(path.grey)}" stroke-width="{_n(path.pen)}"' if path.pen else 'stroke="none"'
    return f'<path d="M{points}{"Z" if path.closed else ""}" fill="{fill}" {stroke}{dash}/>'


def _label(label: Label) -> str:
    style = (' font-weight="bold"' if label.bold else "") + (' font-style="italic"' if label.italic else "")
    return (
        f'<text x="{_n(label.x)}" y="{_n(label.y)}" font-size="{_n(label.size)}" text-anchor="{label.anchor}" '
        f'fill="{_grey(label.grey)}"{style}>{escape(label.text)}</text>'
    )


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.data).decode("ascii")
    return (
        f'<image x="{_n(picture.x)}" y="{_n(picture.y)}" width="{_n(picture.width)}" height="{_n(picture.height)}" '
        f'preserveAspectRatio="none" href="data:{media_type(picture.data)};base64,{data}"/>'
    )


def _n(number: float) -> str:
    return "0" if abs(number) < 0.005 else f"{number:.2f}".rstrip("0").rstrip(".")


def _grey(level: float) -> str:
    value = round(255 * level)
    return f"#{value:02x}{value:02x}{value:02x}"
