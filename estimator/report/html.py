"""The report as one HTML file: no script, nothing from the network, prints on A4."""

from html import escape
from importlib import resources

from .blocks import Banner, Block, Document, Drawing, Gallery, Heading, Paragraph, Table
from .svg import svg

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content security: even a hostile name in a log cannot fetch anything."""


def render_html(document: Document) -> str:
    """The document as text, UTF-8."""
    style = (resources.files("surecut.estimator.report") / "style.css").read_text("utf-8")
    body = "\n".join(_block(block) for block in document.blocks)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(document.title)}</title>
<style>
{style}</style>
</head>
<body>
<header><p class="title">{escape(document.title)}</p><p class="subtitle">{escape(document.subtitle)}</p></header>
<main>
{body}
</main>
<footer>{escape(document.footer)}</footer>
</body>
</html>
"""


def _block(block: Block) -> str:
    match block:
        case Heading():
            turn = ' class="new-page"' if block.new_page else ""
            return f"<h{block.level}{turn}>{escape(block.text)}</h{block.level}>"
        case Paragraph():
            kind = ' class="note"' if block.note else ""
            return f"<p{kind}>{escape(block.text)}</p>"
        case Banner():
            return _banner(block)
        case Table():
            return _table(block)
        case Drawing():
            return _drawing(block)
        case Gallery():
            return f'<div class="gallery">{"".join(_drawing(drawing) for drawing in block.drawings)}</div>'


def _banner(banner: Banner) -> str:
    details = "".join(f"<li>{escape(detail)}</li>" for detail in banner.details)
    figures = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in banner.figures)
    return (
        f'<section class="verdict" data-point="{escape(banner.point)}" data-verdict="{escape(banner.word)}">'
        f'<div class="sign">{svg(banner.sign)}</div><div><p class="word">{escape(banner.word)}</p>'
        f'<p class="headline">{escape(banner.headline)}</p><dl>{figures}</dl>'
        f"<ul>{details}</ul></div></section>"
    )


def _table(table: Table) -> str:
    def cell(tag: str, index: int, text: str) -> str:
        kind = ' class="number"' if index in table.numeric else ""
        return f"<{tag}{kind}>{escape(text)}</{tag}>"

    columns = "".join(f'<col style="width:{width * 100:.4g}%">' for width in table.widths)
    header = "".join(cell("th", i, text) for i, text in enumerate(table.header))
    rows = [f"<tr>{''.join(cell('td', i, text) for i, text in enumerate(row))}</tr>" for row in table.rows]
    body, foot = rows[: len(rows) - table.total], rows[len(rows) - table.total :]
    total = f"<tfoot>{''.join(foot)}</tfoot>" if foot else ""
    head = f"<thead><tr>{header}</tr></thead>" if any(table.header) else ""
    return (
        f"<table><caption>{escape(table.caption)}</caption><colgroup>{columns}</colgroup>"
        f"{head}<tbody>{''.join(body)}</tbody>{total}</table>"
    )


def _drawing(drawing: Drawing) -> str:
    return f"<figure>{svg(drawing.figure)}<figcaption>{escape(drawing.caption)}</figcaption></figure>"
