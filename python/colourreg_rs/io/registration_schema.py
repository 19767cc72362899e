"""What registration and camera files look like. Imported only when one is read: pydantic takes its time to load."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Pixels = Annotated[int, Field(gt=0, le=1 << 24)]


class _Part(BaseModel):
    # Later versions add keys, and others may have their own: what is not known is left alone.
    model_config = ConfigDict(strict=True, extra="ignore", frozen=True)


class CameraPart(_Part):
    """Interior orientation."""

    model: Literal["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"]
    width: Pixels
    height: Pixels
    params: dict[str, Number] = Field(default_factory=dict)


class PosePart(_Part):
    """Exterior orientation."""

    rotation: tuple[Vector3, Vector3, Vector3]
    translation: Vector3


class CovariancePart(_Part):
    """Parameters and their covariance."""

    parameters: list[str]
    matrix: list[list[Number]]


class PointPart(_Part):
    """A control or check point."""

    name: str
    role: Literal["control", "check"] = "control"
    xyz: Vector3
    xy: Vector2
    sigma_xyz: Vector3 | None = None
    sigma_xy: Vector2 | None = None
    residual_xy: Vector2 | None = None
    status: str | None = None


class ViewPart(_Part):
    """A photo with its orientation."""

    name: str | None = None
    image: str | None = None
    camera: CameraPart | None = None
    pose: PosePart | None = None
    dlt: tuple[Vector4, Vector4, Vector4] | None = None
    dlt_distortion: dict[Literal["k1", "k2", "p1", "p2", "k3"], Number] | None = None
    size: tuple[Pixels, Pixels] | None = None
    covariance: CovariancePart | None = None
    method: str | None = None
    points: list[PointPart] | None = None
    statistics: dict[str, Any] | None = None


class RegistrationPart(_Part):
    """The whole file, after ``format`` and ``version``."""

    cloud: str | None = None
    crs_wkt: str | None = None
    views: Annotated[list[ViewPart], Field(min_length=1)]
