"""How long a torque may be unknown: estimates from recordings with gaps that are bridged, and from parts of them.

Two seconds into each training recording of the hub-driven beam the torque is left out for a while. Bridged, it is a
straight line there; otherwise vjm decides. Errors are in standard errors, from the estimates without gaps.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from clock import ROOT, header

sys.path.insert(0, str(ROOT))

import vjm
from tests.fine_beam.make_hub import write_hub_experiment

GAPS = (0.01, 0.02, 0.05, 0.1, 0.2)  # s
NAMES = ("beam.bending_stiffness", "beam.kelvin_voigt_time", "beam.hub_inertia")


def with_gap(experiment: vjm.Experiment, gap: float, bridged: bool) -> vjm.Experiment:
    recordings = []
    for recording in experiment.recordings:
        time, torque = recording.time, recording.tau[:, 0].copy()
        if recording.role == "train":
            torque[(time > 2.0) & (time < 2.0 + gap)] = np.nan
            known = np.isfinite(torque)
            if bridged:
                torque = np.interp(time, time[known], torque[known])
        recordings.append(replace(recording, tau=torque[:, None]))
    return replace(experiment, recordings=tuple(recordings))


def main() -> None:
    header("gaps in the torque")
    with tempfile.TemporaryDirectory() as folder:
        experiment = vjm.load_experiment(write_hub_experiment(Path(folder), 1))
    whole = vjm.identify(experiment, "trajectory", baselines=False)
    for gap in GAPS:
        for how, bridged in (("bridged", True), ("as it is", False)):
            changed = with_gap(experiment, gap, bridged)
            used = sum(float(np.ptp(recording.time)) for recording in changed.cleaned_recordings)
            fit = vjm.identify(changed, "trajectory", baselines=False)
            errors = [(fit[name].value - whole[name].value) / whole[name].std for name in NAMES]
            told = ", ".join(f"{name.split('.')[1]} {error:.1f}" for name, error in zip(NAMES, errors, strict=True))
            print(f"  {gap:5g} s, {how:8}: {used:4.1f} s of recordings used; {told}", flush=True)


if __name__ == "__main__":
    main()
