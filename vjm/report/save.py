"""A result as a folder: result.json, model.json, model.urdf, report.html and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vjm.chain.records import Chain
from vjm.files import json_text
from vjm.identification.records import Identification
from vjm.model_file import write_model
from vjm.report.comparison import Comparison
from vjm.report.figures.pictures import NAMES, Picture, identification_pictures, replay_pictures
from vjm.report.folder import check_folder, write_together
from vjm.report.page import comparison_page, identification_page
from vjm.report.stored import identification_extra
from vjm.result import comparison_result, identification_result
from vjm.urdf import chain_to_urdf

REPORT = "report.html"
_FIGURES = "figures"


@dataclass(frozen=True)
class _Content:
    """All that goes into the folder, before a byte of it is written."""

    result: Mapping[str, Any]
    page: str
    pictures: Sequence[Picture]
    chain: Chain
    extra: Mapping[str, Any]


def save(result: Identification | Comparison, directory: Path | str) -> Path:
    """Write a result as a folder; all of it or, when anything fails, nothing.

    Args:
        result: of an identification, or of a comparison.
        directory: made if need be (its parent exists). Files of an earlier result are replaced, others stay.

    Returns:
        The folder.

    Raises:
        FolderError: the folder cannot be written to.
    """
    folder = check_folder(directory)
    content = _identification(result) if isinstance(result, Identification) else _comparison(result)
    return write_together(folder, lambda stage: _fill(stage, content), [f"{_FIGURES}/{name}.png" for name in NAMES])


def _identification(fit: Identification) -> _Content:
    pictures = identification_pictures(fit)
    page = identification_page(fit, pictures)
    return _Content(identification_result(fit), page, pictures, fit.model.chain, identification_extra(fit))


def _comparison(comparison: Comparison) -> _Content:
    pictures = replay_pictures(comparison.recordings, comparison.model, comparison.nominal)
    page = comparison_page(comparison, pictures)
    return _Content(comparison_result(comparison), page, pictures, comparison.model.chain, comparison.extra)


def _fill(stage: Path, content: _Content) -> None:
    (stage / _FIGURES).mkdir()
    for picture in content.pictures:
        (stage / _FIGURES / f"{picture.name}.png").write_bytes(picture.png)
    (stage / REPORT).write_text(content.page, encoding="utf-8")
    (stage / "model.urdf").write_text(chain_to_urdf(content.chain), encoding="utf-8")
    write_model(content.chain, stage / "model.json", content.extra)
    (stage / "result.json").write_text(json_text(content.result), encoding="utf-8")
