from __future__ import annotations

import pytest

from tests.report.fits import FITS, SHARED
from vjm.identification.records import Identification


# Of those with driven joints the elbow's is always drawn, the others' in the slow suite.
@pytest.fixture(
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name in ("demo", "hub", "torque"))) for name in FITS]
)
def fit(request: pytest.FixtureRequest) -> Identification:
    name: str = request.param
    if name in ("hub", "silicone") and not SHARED.is_dir():
        pytest.skip("the recordings of these rigs are not part of the repository")
    return FITS[name]()
