"""A result as a page, and as a folder: result.json, model.json, model.urdf, report.html and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vjm.diagnosis.records import Diagnosis
from vjm.errors import require_kind, require_progress
from vjm.files import check_folder, json_text, write_folder
from vjm.identification.check import Check
from vjm.identification.records import Comparison
from vjm.records import Progress
from vjm.report.diagnosis import diagnosis_page
from vjm.report.figures.diagnosis import diagnosis_pictures
from vjm.report.figures.identification import identification_pictures
from vjm.report.figures.panels import Picture
from vjm.report.identification import identification_page
from vjm.report.model_json import model_text
from vjm.report.page import Page
from vjm.report.result_json import result_object

REPORT = "report.html"
# Every name that a picture may have: what an earlier run left of them is out of date.
_PICTURES = (
    *("fit", "gain", "correlations", "shapes", "angles", "torque_errors", "markers"),
    *(f"residual_{name}" for name in ("map", "spectra")),
    *(f"symptom_{name}" for name in ("overview", "bands", "amplitude", "profiles", "lag", "quiet")),
    *(f"{name}_{k}" for name in ("tip", "cause", "held_out") for k in range(1, 5)),
)
_FILES = (REPORT, "model.urdf", "model.json", "result.json", *(f"figures/{name}.png" for name in _PICTURES))


def result_page(result: Check | Comparison | Diagnosis, pictures: Sequence[Picture] | None = None) -> Page:
    """Return a result's page: the report with its pictures, or without any the summary."""
    if isinstance(result, Diagnosis):
        return diagnosis_page(result, pictures)
    return identification_page(result, pictures)


def check_result_folder(directory: Path | str) -> Path:
    """Return the folder as a path if a result can be saved in it; nothing is made yet.

    Raises:
        FolderError: it cannot be written to, or a file would be lost that vjm did not write.
        ShapeError: no path.
    """
    return check_folder(directory, _FILES)


def save(
    result: Comparison | Diagnosis, directory: Path | str, command: str = "", progress: Progress | None = None
) -> Path:
    """Write a result as a folder; all of it or, if anything fails, nothing.

    Args:
        result: of an identification, of a comparison, or of a diagnosis.
        directory: made if need be (its parent exists). Files of an earlier result are replaced or removed, others stay.
        command: the command line, for the report to tell; empty where there is none.
        progress: told (text, done, total) before each picture.

    Returns:
        The folder.

    Raises:
        FolderError: the folder cannot be written to, or a file would be lost that vjm did not write.
        ShapeError: no such result, no path, or another argument of the wrong kind.
    """
    require_kind("result", result, (Comparison, Diagnosis), "what vjm.identify, compare or diagnose returned")
    require_kind("command", command, str, "the command line, a text")
    require_progress(progress)
    folder = check_result_folder(directory)
    if isinstance(result, Diagnosis):
        pictures, covariance = diagnosis_pictures(result), None
    else:
        pictures, covariance = identification_pictures(result), result.covariance
    images: dict[str, bytes] = {}
    for k, picture in enumerate(pictures):
        if progress is not None:
            progress(f"drawing {picture.name}", k, len(pictures))
        images[f"figures/{picture.name}.png"] = picture.png
    texts = {
        REPORT: result_page(result, pictures).html(command=command),
        "model.urdf": result.model.arm.urdf(),
        "model.json": model_text(result.model, covariance),
        "result.json": json_text(result_object(result)),  # last: it describes the others
    }
    return write_folder(folder, {**images, **texts}, _FILES)
