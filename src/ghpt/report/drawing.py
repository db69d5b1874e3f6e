"""A figure as the bytes of a file."""

from __future__ import annotations

import logging
from io import BytesIO

import matplotlib
from matplotlib.figure import Figure

# fontTools logs every glyph that goes into a PDF
logging.getLogger("fontTools").setLevel(logging.WARNING)


def draw(figure: Figure, kind: str) -> bytes:
    """Return the figure as a file; the same bytes for the same figure.

    It has no date and no random names. Letters are outlines, so that no font is needed.
    """
    drawn = BytesIO()
    date = "Date" if kind == "svg" else "CreationDate"
    with matplotlib.rc_context(
        {"svg.hashsalt": "ghpt", "svg.fonttype": "path", "pdf.fonttype": 42}
    ):
        figure.savefig(drawn, format=kind, metadata={date: None})
    return drawn.getvalue()
