"""Simulated rigs with smaller images."""

from dataclasses import replace


def scaled(rig, width):
    """The rig with smaller images of the same field of view, so many pixels wide."""
    cameras = []
    for camera in rig.cameras:
        m = camera.model
        scale = width / m.width
        model = replace(
            m,
            width=width,
            height=round(m.height * scale),
            fx=m.fx * scale,
            fy=m.fy * scale,
            cx=(m.cx + 0.5) * scale - 0.5,
            cy=(m.cy + 0.5) * scale - 0.5,
        )
        cameras.append(replace(camera, model=model))
    return replace(rig, cameras=tuple(cameras))
