"""A picture of a notebook for the gallery of the README: run it, keep one of its figures, make it small.

    python .ci/gallery.py NAME [NUMBER]

The figure (by default the first) goes to notebooks/figures/NAME.png with at most 60 KB.
"""

import base64
import io
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parents[1] / "notebooks"
MOST = 60_000


def pictures(name: str) -> list[bytes]:
    """All figures of a notebook, executed from the top."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(FOLDER)}}).execute()
    found = [out.get("data", {}) for cell in notebook.cells for out in cell.get("outputs", [])]
    return [base64.b64decode(data["image/png"]) for data in found if "image/png" in data]


def small(picture: bytes, most: int = MOST) -> bytes:
    """The same with fewer colours, and fewer points if that is not enough."""
    whole = Image.open(io.BytesIO(picture)).convert("RGB")
    for part, colours in ((1.0, 256), (1.0, 128), (0.8, 256), (0.8, 128), (0.6, 128), (0.4, 128)):
        size = (round(part * whole.width), round(part * whole.height))
        resized = whole.resize(size, Image.Resampling.LANCZOS)
        file = io.BytesIO()
        resized.quantize(colours, Image.Quantize.FASTOCTREE, dither=0).save(
            file, "png", optimize=True
        )
        if len(file.getvalue()) <= most:
            return file.getvalue()
    raise SystemExit(f"The picture does not fit into {most} bytes.")


if __name__ == "__main__":
    name, number = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 0
    target = FOLDER / "figures" / f"{name}.png"
    target.write_bytes(small(pictures(name)[number]))
    print(f"{target.relative_to(FOLDER.parent)}: {target.stat().st_size} bytes")
