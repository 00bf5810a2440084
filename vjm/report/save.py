"""A result as a folder: result.json, model.json, model.urdf, report.html and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vjm.files import check_folder, json_text, write_together
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.report.figures import diagnosis as of_diagnosis
from vjm.report.figures import symptoms as of_symptoms
from vjm.report.figures.diagnosis import diagnosis_pictures
from vjm.report.figures.pictures import NAMES, identification_pictures, replay_pictures
from vjm.report.figures.style import Picture
from vjm.report.model_json import diagnosis_extra, identification_extra, stored_effects, write_model
from vjm.report.page import comparison_page, diagnosis_page, identification_page
from vjm.report.result_json import comparison_result, diagnosis_result, identification_result
from vjm.simulation.model import Model, extended_urdf

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis

REPORT = "report.html"
_FIGURES = "figures"
_ALL_NAMES = (*NAMES, *of_symptoms.NAMES, *of_diagnosis.NAMES)


@dataclass(frozen=True)
class _Content:
    """All that goes into the folder, before a byte of it is written."""

    result: Mapping[str, Any]
    page: str
    pictures: Sequence[Picture]
    model: Model
    extra: Mapping[str, Any]


def save(result: Identification | Comparison | Diagnosis, directory: Path | str) -> Path:
    """Write a result as a folder; all of it or, when anything fails, nothing.

    Args:
        result: of an identification, of a comparison, or of a diagnosis.
        directory: made if need be (its parent exists). Files of an earlier result are replaced, others stay.

    Returns:
        The folder.

    Raises:
        FolderError: the folder cannot be written to.
    """
    folder = check_folder(directory)
    content = _content(result)
    stale = [f"{_FIGURES}/{name}.png" for name in _ALL_NAMES]
    return write_together(folder, lambda stage: _fill(stage, content), stale)


def _content(result: Identification | Comparison | Diagnosis) -> _Content:
    if isinstance(result, Identification):
        return _identification(result)
    return _comparison(result) if isinstance(result, Comparison) else _diagnosis(result)


def _identification(fit: Identification) -> _Content:
    pictures = identification_pictures(fit)
    page = identification_page(fit, pictures)
    return _Content(identification_result(fit), page, pictures, fit.model, identification_extra(fit))


def _comparison(comparison: Comparison) -> _Content:
    pictures = replay_pictures(comparison.recordings, comparison.model, comparison.nominal)
    page = comparison_page(comparison, pictures)
    return _Content(comparison_result(comparison), page, pictures, comparison.model, comparison.extra)


def _diagnosis(diagnosis: Diagnosis) -> _Content:
    pictures = diagnosis_pictures(diagnosis)
    page = diagnosis_page(diagnosis, pictures)
    return _Content(diagnosis_result(diagnosis), page, pictures, diagnosis.model, diagnosis_extra(diagnosis))


def _fill(stage: Path, content: _Content) -> None:
    (stage / _FIGURES).mkdir()
    for picture in content.pictures:
        (stage / _FIGURES / f"{picture.name}.png").write_bytes(picture.png)
    (stage / REPORT).write_text(content.page, encoding="utf-8")
    model = content.model
    (stage / "model.urdf").write_text(extended_urdf(model.chain, model.effects), encoding="utf-8")
    write_model(model.chain, stage / "model.json", content.extra, stored_effects(model))
    (stage / "result.json").write_text(json_text(content.result), encoding="utf-8")
