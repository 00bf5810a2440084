"""Where the URDF templates are, and how they are filled in."""

from __future__ import annotations

from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined

from vjm.errors import VjmError

_FOLDER = "urdf_templates"


def template_folder() -> Traversable:
    """The templates: inside an installed package, or next to it in a checkout.

    Raises:
        VjmError: they are in neither place; the installation is broken.
    """
    package = resources.files("vjm")
    places = [package / _FOLDER, Path(str(package)).parent / _FOLDER]
    for place in places:
        if place.is_dir():
            return place
    raise VjmError(f"vjm's URDF templates are missing: looked in {' and '.join(map(str, places))}; reinstall vjm")


def render(template: str, **values: object) -> str:
    """Fill in a template: text is escaped for XML, floats are written so that they come back exactly."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    folder = template_folder()
    return Environment(
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_exact,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _exact(value: object) -> object:
    return repr(float(value)) if isinstance(value, float | np.floating) else value
