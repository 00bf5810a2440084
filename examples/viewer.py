"""The identified arm in a browser: its free vibration in Meshcat, and the same as a file that needs no server.

python examples/viewer.py [vjm-out/model.json]        (pip install "vjm[viewer]"; --open opens the browser)
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin
from meshcat.animation import Animation
from pinocchio.visualize import MeshcatVisualizer

import vjm

RATE, DURATION, BEND = 50, 4.0, 0.6  # frames per second, s, and heading of the tip where the motion begins [rad]


def main(file="vjm-out/model.json", *options):
    model = vjm.load_model(file)
    with tempfile.TemporaryDirectory() as folder:
        urdf = str(model.to_urdf(Path(folder) / "arm.urdf"))
        flexible = vjm.FlexibleModel.from_urdf(urdf)
        robot = flexible.model
        shapes = pin.buildGeomFromUrdf(robot, urdf, pin.GeometryType.VISUAL)
    start = np.zeros((2, model.chain.size))
    start[0, model.chain.passive] = BEND / model.chain.passive.size
    motion = model.simulate(duration=DURATION, initial=start)
    frames = np.linspace(0, DURATION, round(RATE * DURATION) + 1)
    q = flexible.configuration(np.stack([np.interp(frames, motion.time, angle) for angle in motion.q.T], axis=1))

    viewer = MeshcatVisualizer(robot, shapes, shapes)
    viewer.initViewer(open="--open" in options)
    viewer.loadViewerModel()
    reach = sum(link.length for link in model.rig.links)
    viewer.setBackgroundColor()
    viewer.viewer["/Grid"].set_property("visible", False)
    # Seen from above, the base in the middle; the camera's own second axis points up.
    viewer.viewer["/Cameras/default/rotated/<object>"].set_property("position", [0.0, 1.1 * reach, 0.7 * reach])
    animation = Animation(default_framerate=RATE)
    data = robot.createData()
    for k, posture in enumerate(q):
        pin.forwardKinematics(robot, data, posture)
        pin.updateGeometryPlacements(robot, data, shapes, viewer.visual_data)
        with animation.at_frame(viewer.viewer, k) as frame:
            for place, shape in zip(viewer.visual_data.oMg, shapes.geometryObjects, strict=True):
                name = viewer.getViewerNodeName(shape, pin.GeometryType.VISUAL)
                frame[name].set_transform(place.homogeneous)
    viewer.viewer.set_animation(animation)
    Path("arm.html").write_text(viewer.viewer.static_html(), encoding="utf-8")
    print(f"{len(q)} frames of {model.rig.name}: {viewer.viewer.url()} while this runs, arm.html for good")
    if "--open" in options:
        input("Enter ends it")


if __name__ == "__main__":
    main(*sys.argv[1:])
