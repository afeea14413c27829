"""Scans and the images that coloured them in one E57 file (ASTM E2807), for CloudCompare."""

import errno
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path

import cv2
import numpy as np
from pye57 import E57, libe57
from scipy.spatial.transform import RigidTransform, Rotation

from lrfcal_lib.calibrate.cloud import Cloud
from lrfcal_lib.calibrate.painting import View
from lrfcal_lib.session.images import encode_jpeg

AT_ONCE = 1 << 18  # points that are handed over to the library
PIXEL = 5e-6  # metres; E57 wants a focal length in metres, of which only the ratio counts
QUALITY = 95  # of JPEG
WIDER = 1.15  # times as wide and high as the recorded one is an image without distortion
COLORS = ("colorRed", "colorGreen", "colorBlue")
COLOR_LIMITS = {
    "colorRedMinimum": 0,
    "colorRedMaximum": 255,
    "colorGreenMinimum": 0,
    "colorGreenMaximum": 255,
    "colorBlueMinimum": 0,
    "colorBlueMaximum": 255,
}
POINT = ("cartesianX", "cartesianY", "cartesianZ")
# E57 looks along -z, y up; ours along z, y down
E57_FROM_OPENCV = RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0.0, 0.0]))


class E57Writer(AbstractContextManager):
    """Writes an E57 file scan by scan, each scan block by block; a context manager.

    Parameters
    ----------
    path
        Where nothing stands yet.
    about
        A sentence that every scan carries.

    Raises
    ------
    OSError
        At the end, where it cannot be written.
    """

    def __init__(self, path: Path, about: str):
        self.about = about
        self._file = E57(str(path), "w")
        self._image_file = self._file.image_file

    def __exit__(self, kind, error, trace):
        try:
            self._image_file.close()
        except libe57.E57Exception as failed:
            error = error or failed
        del self._file.image_file  # it would be closed once more, and complain at that
        if isinstance(error, libe57.E57Exception):
            raise OSError(errno.EIO, f"E57: {error}") from error

    def scan(
        self,
        name: str,
        guid: str,
        T_file_scan: RigidTransform,
        intensity: bool,
        clouds: Iterable[Cloud],
    ) -> Iterator[Cloud]:
        """Append a scan, block by block.

        Parameters
        ----------
        name, guid
            What CloudCompare shows, and what images refer to.
        T_file_scan
            Its pose.
        intensity
            Whether its points have one.
        clouds
            Its points in its own frame.

        Yields
        ------
        Cloud
            Each of the blocks once it is written.
        """
        fields = [*POINT, *COLORS, "intensity"] if intensity else [*POINT, *COLORS]
        prototype = libe57.StructureNode(self._image_file)
        for field in fields:
            node = libe57.FloatNode(self._image_file, 0.0, libe57.E57_SINGLE)
            if field in COLORS:
                node = libe57.IntegerNode(self._image_file, 0, 0, 255)
            prototype.set(field, node)
        codecs = libe57.VectorNode(self._image_file, True)
        points = libe57.CompressedVectorNode(self._image_file, prototype, codecs)
        scan = {
            "guid": guid,
            "name": name,
            "description": self.about,
            "pose": _pose(T_file_scan),
            "colorLimits": COLOR_LIMITS,
            "points": points,
        }
        self._file.data3d.append(self._node(scan))
        arrays, buffers = self._file.make_buffers(fields, AT_ONCE)
        writer = points.writer(buffers)
        try:
            for cloud in clouds:
                columns = (*cloud.points.T, *cloud.colors.T, cloud.intensity)
                for start in range(0, len(cloud.points), AT_ONCE):
                    for array, column in zip(arrays.values(), columns, strict=False):
                        part = column[start : start + AT_ONCE]
                        array[: len(part)] = part
                    writer.write(len(part))
                yield cloud
        finally:
            writer.close()

    def image(
        self, name: str, scan: str, T_file_camera: RigidTransform, view: View
    ) -> None:
        """Append an image without its distortion, posed in the frame of the file.

        Parameters
        ----------
        name
        scan
            The guid of the scan that it belongs to.
        T_file_camera
            Pose of the camera (OpenCV's axes).
        view
            Its pixels and intrinsics.
        """
        lens = (view.model.matrix, view.model.distortion)
        # all of the image, and room for it
        wide = np.rint(WIDER * view.model.size).astype(int).tolist()
        matrix, _ = cv2.getOptimalNewCameraMatrix(*lens, view.model.size, 1.0, wide)
        maps = cv2.initUndistortRectifyMap(*lens, None, matrix, wide, cv2.CV_32FC2)[0]
        flat = cv2.remap(view.image, maps, None, cv2.INTER_LINEAR)
        jpeg = bytearray(encode_jpeg(flat, QUALITY))
        blob = libe57.BlobNode(self._image_file, len(jpeg))
        image = {
            "guid": new_guid(),
            "name": name,
            "description": f"{self.about}; distortion removed",
            "associatedData3DGuid": scan,
            "pose": _pose(T_file_camera * E57_FROM_OPENCV),
            "pinholeRepresentation": _pinhole(matrix, wide) | {"jpegImage": blob},
        }
        self._file.root["images2D"].append(self._node(image))
        blob.write(jpeg, 0, len(jpeg))

    def _node(self, value):
        """A value as a node; mappings become structures, nodes stay."""
        if isinstance(value, Mapping):
            structure = libe57.StructureNode(self._image_file)
            for key, child in value.items():
                structure.set(key, self._node(child))
            return structure
        plain = {
            str: libe57.StringNode,
            int: libe57.IntegerNode,
            float: libe57.FloatNode,
        }
        for kind, node in plain.items():
            if isinstance(value, kind):
                return node(self._image_file, value)
        return value


def _pose(T):
    """A RigidTransform as a structure."""
    turn = T.rotation.as_quat(canonical=True, scalar_first=True).tolist()
    return {
        "rotation": dict(zip("wxyz", turn, strict=True)),
        "translation": dict(zip("xyz", T.translation.tolist(), strict=True)),
    }


def _pinhole(matrix, size):
    """Intrinsics (3, 3) of an image as a structure; E57 counts pixels from the image's corner."""
    width, height = size
    focal = PIXEL * matrix[1, 1]
    return {
        "imageWidth": width,
        "imageHeight": height,
        "focalLength": focal,
        "pixelWidth": focal / matrix[0, 0],
        "pixelHeight": PIXEL,
        "principalPointX": matrix[0, 2] + 0.5,
        "principalPointY": matrix[1, 2] + 0.5,
    }


def new_guid() -> str:
    """A name that nothing else has."""
    return f"{{{uuid.uuid4()}}}"
