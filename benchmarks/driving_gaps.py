"""How long a torque or a given motion may be unknown: estimates from recordings with gaps, bridged or as vjm uses them.

Two seconds into each training recording of the hub-driven beam the torque, or the angle that is given as motion, is
left out for a while. Bridged, it is a straight line or a cubic spline there; otherwise vjm decides. Errors are in
standard errors, from the estimates without gaps.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from clock import ROOT, header
from scipy.interpolate import CubicSpline

sys.path.insert(0, str(ROOT))

import vjm
from tests.fine_beam.make_hub import write_hub_experiment

GAPS = (0.01, 0.02, 0.05, 0.1, 0.2)  # s
NAMES = {
    "torque": ("beam.bending_stiffness", "beam.kelvin_voigt_time", "beam.hub_inertia"),
    "motion": ("beam.bending_stiffness", "beam.kelvin_voigt_time"),
}


def with_gap(experiment: vjm.Experiment, gap: float, bridged: bool) -> vjm.Experiment:
    recordings = []
    for recording in experiment.recordings:
        column = "tau" if recording.input == "torque" else "theta"
        time, driving = recording.time, getattr(recording, column)[:, 0].copy()
        if recording.role == "train":
            driving[(time > 2.0) & (time < 2.0 + gap)] = np.nan
            known = np.isfinite(driving)
            if bridged and column == "tau":
                driving = np.interp(time, time[known], driving[known])
            elif bridged:
                driving = CubicSpline(time[known], driving[known])(time)
        recordings.append(replace(recording, **{column: driving[:, None]}))
    return replace(experiment, recordings=tuple(recordings))


def main() -> None:
    header("gaps in the torque or in a given motion")
    with tempfile.TemporaryDirectory() as folder:
        by_torque = vjm.load_experiment(write_hub_experiment(Path(folder), 1))
    by_motion = replace(by_torque, recordings=tuple(replace(each, input="motion") for each in by_torque.recordings))
    for experiment in (by_torque, by_motion):
        driven_by = experiment.recordings[0].input
        whole = vjm.identify(experiment, "trajectory", baselines=False)
        for gap in GAPS:
            for how, bridged in (("bridged", True), ("as it is", False)):
                changed = with_gap(experiment, gap, bridged)
                used = sum(float(np.ptp(recording.time)) for recording in changed.cleaned_recordings)
                fit = vjm.identify(changed, "trajectory", baselines=False)
                errors = {name: (fit[name].value - whole[name].value) / whole[name].std for name in NAMES[driven_by]}
                told = ", ".join(f"{name.split('.')[1]} {error:.1f}" for name, error in errors.items())
                print(f"  {driven_by} {gap:5g} s, {how:8}: {used:4.1f} s of recordings used; {told}", flush=True)


if __name__ == "__main__":
    main()
