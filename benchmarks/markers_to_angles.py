"""Markers to joint angles: 100,000 frames of 5 markers at n = 4, and how the time grows with the frames."""

from functools import partial

import numpy as np
from clock import header, in_turns, line

from vjm.chain.curve import marker_poses
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.markers.angles import ShapeSettings, estimate_angles
from vjm.records import Link, Recording, Rig

JOINTS, FRAMES = 4, (12_500, 25_000, 50_000, 100_000)
RIG = Rig("beam", (Link("beam", "clamped", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0)),))
CUTS = [layout(1.0, JOINTS)]
# The first is what `vjm identify` does by default with this many markers; the others are options.
WAYS = {
    "curvature, robust": ShapeSettings("cantilever", (3,), "curvature", robust=True),
    "curvature": ShapeSettings("cantilever", (3,), "curvature"),
    "points, as in the paper": ShapeSettings("polynomial", (4,), "points"),
    "curve": ShapeSettings("cantilever", (3,), "curve"),
}
LIMITED = ("curvature, robust", "curvature")


def recording(frames: int) -> Recording:
    time = np.arange(frames) / 100.0
    q = 0.05 * np.sin(2 * np.pi * np.outer(time, [1.1, 1.3, 2.0, 7.0]))
    chain = Chain("beam", (uniform_chain(RIG.links[0], CUTS[0]),))
    markers = marker_poses(chain, q, (np.array(RIG.links[0].markers),), (False,))[0]
    markers += np.random.default_rng(0).normal(scale=3e-4, size=markers.shape)
    none = np.empty((frames, 0))
    return Recording(time, markers, none, none, kind="decay", role="train", file="beam.csv")


def main() -> None:
    recordings = {frames: recording(frames) for frames in FRAMES}
    header(f"markers to angles, 5 markers, n = {JOINTS}")
    for name, settings in WAYS.items():
        tasks = {
            str(frames): partial(estimate_angles, RIG, CUTS, given, settings, 3e-4, 1e-4)
            for frames, given in recordings.items()
        }
        times = in_turns(tasks, repeats=3 if name == "curve" else 5)
        medians = np.array([np.median(times[str(frames)]) for frames in FRAMES])
        growth = np.polyfit(np.log(FRAMES), np.log(medians), 1)[0]
        line(f"{name}: {FRAMES[-1]:,} frames", float(medians[-1]), "s", 2.0 if name in LIMITED else None)
        line(f"{name}: time grows with the frames to the power", float(growth))


if __name__ == "__main__":
    main()
