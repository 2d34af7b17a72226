"""What ROS depth images and camera infos say, the same for a bag and for a live topic."""

from __future__ import annotations

import logging
from io import BytesIO
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from ..camera import PinholeCamera
from ..errors import CameraError, DatasetError
from .sequence import UNREADABLE

logger = logging.getLogger(__name__)

# REP 118: depth images are 32FC1 in metres or 16UC1 in millimetres; some drivers call the latter mono16.
SCALES = {"32FC1": 1.0, "16UC1": 1000.0, "mono16": 1000.0}
COMPRESSED_HEADER = 12  # bytes that compressed_depth_image_transport writes before the PNG


def camera_from_info(info: Any, rectified: bool, name: str) -> PinholeCamera:
    """The pinhole camera of a CameraInfo: its K, or its P where the image is rectified.

    Args:
        info: of ROS 1 or ROS 2.
        rectified: the image is; else lens distortion is warned about, for it is not corrected.
        name: begins the message of the DatasetError when the numbers are no camera's.
    """
    # ROS 1 writes the matrices' names in capitals.
    K, P, D = (np.asarray(getattr(info, n, getattr(info, n.lower(), ()))) for n in "KPD")
    rectified = rectified and bool(P.any())
    if D.any() and not rectified:
        logger.warning("%s: the lens distortion is not corrected", name)
    M = P.reshape(3, 4) if rectified else K.reshape(3, 3)
    try:
        fx, fy, cx, cy = (float(v) for v in (M[0, 0], M[1, 1], M[0, 2], M[1, 2]))
        return PinholeCamera(fx, fy, cx, cy, int(info.width), int(info.height))
    except CameraError as error:
        raise DatasetError(f"{name}: {error}") from error


def header_time(message: Any, bag_time: int) -> float:
    """When a message's content was measured [s]; the time it was recorded where its header says nothing."""
    stamp = message.header.stamp
    nanoseconds = stamp.sec * 1_000_000_000 + stamp.nanosec
    return (nanoseconds or bag_time) * 1e-9


def decode_depth(message: Any, name: str) -> Float[np.ndarray, "h w"]:
    """An Image or compressedDepth message in metres; 0 or NaN where invalid."""
    if not hasattr(message, "encoding"):
        if not message.format.startswith("16UC1"):
            raise DatasetError(
                f"{name}: compressed as {message.format!r}; only 16UC1 compressedDepth can be read"
            )
        try:
            with Image.open(BytesIO(bytes(message.data[COMPRESSED_HEADER:]))) as image:
                return np.array(image).astype(np.float32) / SCALES["16UC1"]
        except UNREADABLE as error:
            raise DatasetError(f"{name}: not a readable PNG ({error})") from error
    if message.encoding not in SCALES:
        raise DatasetError(
            f"{name}: encoding {message.encoding!r} is no depth; expected one of {', '.join(SCALES)}"
        )
    kind = np.dtype("f4" if message.encoding == "32FC1" else "u2").newbyteorder(
        ">" if message.is_bigendian else "<"
    )
    try:
        rows = np.asarray(message.data).reshape(message.height, message.step)[
            :, : message.width * kind.itemsize
        ]
        depth = np.ascontiguousarray(rows).view(kind).astype(np.float32)
    except ValueError as error:
        raise DatasetError(f"{name}: its data does not fit its size ({error})") from error
    return depth / SCALES[message.encoding]
