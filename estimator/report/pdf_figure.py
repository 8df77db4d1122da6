"""A figure as strokes on a PDF canvas."""

import io

from reportlab.lib.utils import ImageReader
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import Flowable

from .figure import Figure, Label, Path, Picture

FONT = "STIXGeneral"


class FigureFlowable(Flowable):
    """The figure at its own size, made smaller where `width` is less."""

    def __init__(self, figure: Figure, width: float) -> None:
        super().__init__()
        self._figure = figure
        self._scale = min(1.0, width / figure.width)
        self.width = figure.width * self._scale
        self.height = figure.height * self._scale

    def wrap(self, aW: float, aH: float) -> tuple[float, float]:
        return self.width, self.height

    def draw(self) -> None:
        canvas: Canvas = self.canv
        canvas.saveState()
        canvas.scale(self._scale, self._scale)
        for stroke in self._figure.strokes:
            if isinstance(stroke, Path):
                self._path(canvas, stroke)
            elif isinstance(stroke, Label):
                self._label(canvas, stroke)
            else:
                self._picture(canvas, stroke)
        canvas.restoreState()

    def _y(self, y: float) -> float:
        return self._figure.height - y

    def _path(self, canvas: Canvas, path: Path) -> None:
        pen = canvas.beginPath()
        for index, (x, y) in enumerate(path.points):
            (pen.moveTo if index == 0 else pen.lineTo)(float(x), self._y(float(y)))
        if path.closed:
            pen.close()
        canvas.setLineWidth(path.pen)
        canvas.setStrokeGray(path.grey)
        canvas.setDash(list(path.dash))
        if path.fill is not None:
            canvas.setFillGray(path.fill)
        canvas.drawPath(pen, stroke=int(path.pen > 0), fill=int(path.fill is not None))

    def _label(self, canvas: Canvas, label: Label) -> None:
        face = "-Bold" if label.bold else "-Italic" if label.italic else ""
        canvas.setFont(FONT + face, label.size)
        canvas.setFillGray(label.grey)
        draw = {"start": canvas.drawString, "middle": canvas.drawCentredString, "end": canvas.drawRightString}
        draw[label.anchor](label.x, self._y(label.y), label.text)

    def _picture(self, canvas: Canvas, picture: Picture) -> None:
        image = ImageReader(io.BytesIO(picture.data))
        y = self._y(picture.y + picture.height)
        canvas.drawImage(image, picture.x, y, picture.width, picture.height)
