"""Draw the pictures of README.md, as `vjm demo` draws them, in few colours to keep them small.

Run from the repository's root: python docs/make_pictures.py
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from PIL import Image

import vjm
from vjm.report.figures.identification import identification_pictures

HERE = Path(__file__).parent
DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"
CHOSEN = {"shapes": "shapes.png", "tip_1": "tip.png"}
COLOURS = 48


def main() -> None:
    fit = vjm.identify(vjm.load_experiment(DEMO))
    for picture in identification_pictures(fit):
        if picture.name in CHOSEN:
            image = Image.open(BytesIO(picture.png)).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
            image.save(HERE / CHOSEN[picture.name], optimize=True)
            print(f"docs/{CHOSEN[picture.name]}: {picture.alternative}")


if __name__ == "__main__":
    main()
