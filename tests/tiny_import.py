"""A small recording as other people published it, of made-up walls."""

import cv2
import numpy as np

BOUGUET = """
fc = [ 700.5 ; 701.5 ];
cc = [ 15.25 ; 11.75 ];
alpha_c = 0.000000000000000;
kc = [ -0.17 ; 0.02 ; -0.0003 ; 0.0004 ; 0.0 ];
%-- Image size:
nx = 32;
ny = 24;
"""


def authors_points(ranges, bearing_deg, p):
    """The README's formulas of the authors' platform, point by point; their bearing and pitch angle."""
    b = np.radians(bearing_deg)
    X = ranges * np.sin(b) - 0.038
    S = ranges * np.cos(b) + 0.0045
    y = 0.157 * np.cos(p) + S * np.sin(p)
    z = 0.157 * np.sin(p) - S * np.cos(p) + 0.2
    return np.round(np.stack([X, y, z], axis=-1), 6)


def polar(rng, lines=6):
    """Ranges (whole millimetres), the authors' bearings and pitch of a few scan lines in acquisition order."""
    rows = [
        np.arange(*np.sort(rng.choice(np.arange(-300, 301), 2, replace=False)) + [0, 9])
        / 10
        for _ in range(lines)
    ]
    ranges = [np.round(1.5 + 0.3 * rng.random(len(row)), 3) for row in rows]
    return ranges, rows, np.linspace(1.0, 1.4, lines)


def write_source(folder, rng):
    folder.mkdir()
    for n in (1, 2):
        ranges, bearings, pitch = polar(rng)
        points = np.concatenate(
            [
                authors_points(r, b, p)
                for r, b, p in zip(ranges, bearings, pitch, strict=True)
            ]
        )
        header = f"# .PCD v.7\nFIELDS x y z\nPOINTS {len(points)}\nDATA ascii\n"
        rows = "\n".join(" ".join(f"{v:.6f}" for v in p) for p in points)
        (folder / f"plane_{n:02d}.pcd").write_text(header + rows)
    for name in ("left", "right"):
        (folder / f"Calib_Results_{name}.m").write_text(BOUGUET)
        for n in (1, 2):
            cv2.imwrite(
                str(folder / f"{name}_{n:02d}.png"),
                rng.integers(0, 255, (24, 32, 3)).astype(np.uint8),
            )
    return folder
