"""The compiled core. Arrays are C-contiguous; a wrong dtype, shape or order is refused with the argument's name.

Frames: *world* is the cloud's frame; the *camera* frame is x right, y down, z forward. Pixel (0, 0) is the centre of
the top-left pixel. Angles are radians. A wrong dtype raises ``TypeError``, a wrong shape ``ValueError``.
"""

from typing import Any, overload

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

__version__: str
debug_build: bool

class ColourregError(Exception):
    """The base of every error of colourreg."""

class InvalidInputError(ColourregError):
    """The values given cannot be worked with; the message holds the value and what to do."""

class DegenerateError(ColourregError):
    """The values do not determine what was asked; the message holds the figure that says so, and its limit."""

class NotConvergedError(ColourregError):
    """An iteration ended without a result that can be trusted."""

class InternalError(ColourregError):
    """A defect of colourreg."""

class View:
    """Camera and pose of one photo, or a DLT matrix (whose camera has a skew). Immutable."""

    @classmethod
    def canonical(
        cls,
        model: str,
        width: int,
        height: int,
        params: FloatArray,
        rotation: FloatArray,
        translation: FloatArray,
    ) -> View:
        """From a camera model's name and parameters (in the order of ``model.PARAMETER_NAMES``) and
        ``x_cam = rotation @ X + translation``. Raises InvalidInputError."""

    def check_plausible(self) -> None:
        """Raises InvalidInputError for a focal length below 0.05 or above 10,000 times the longer side, a principal
        point more than 1,000 times that away, and a distortion that moves what is near to it by half of its
        distance."""

    @classmethod
    def dlt(cls, P: FloatArray, width: int, height: int, distortion: FloatArray) -> View:
        """From a (3, 4) projection matrix of any scale and sign, and distortion terms k1 k2 p1 p2 k3 (5,), which act as
        in OPENCV on coordinates normalised by the matrix's own K. Raises DegenerateError for a camera at infinity."""

    @property
    def model(self) -> str: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def params(self) -> FloatArray: ...
    @property
    def skew(self) -> float: ...
    @property
    def rotation(self) -> FloatArray: ...
    @property
    def translation(self) -> FloatArray: ...
    @property
    def centre(self) -> FloatArray: ...
    @property
    def max_angle(self) -> float:
        """The angle from the optical axis, radians, beyond which the lens model folds back and nothing is visible."""

    def meets(self, xyz: FloatArray) -> bool:
        """Whether any point of the smallest box around these (N, 3) may lie in the photo. ``False`` is certain."""

    def matrix(self) -> FloatArray | None:
        """``K [R | -R C]`` (3, 4), without distortion; ``None`` for fisheye and panorama."""

def project(
    view: View, xyz: FloatArray, *, out_xy: FloatArray | None = None, out_depth: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """World points (N, 3) to pixels (N, 2) and depths (N,).

    Depth is along the optical axis, for fisheye and panorama the range. Both are NaN behind the camera and beyond the
    lens's valid field; a position outside the image is given as it is. With both ``out_xy`` and ``out_depth`` the
    results are written there. Source: the collinearity equations with Brown's or Kannala and Brandt's distortion.
    """

def unproject(view: View, xy: FloatArray) -> FloatArray:
    """Pixels (N, 2) to unit directions (N, 3) in the world frame; NaN where nothing of the valid field is imaged."""

def project_jacobians(view: View, xyz: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pixels (N, 2) and their derivatives: by the world point (N, 2, 3), by the pose (N, 2, 6: rotation vector applied
    on the left, then projection centre), by the camera's parameters (N, 2, K). NaN where not visible."""

def decompose_dlt(P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(3, 4) → K (3, 3, upper triangular, K[2, 2] = 1), R (3, 3), projection centre (3,), and the matrix scaled so that
    its third row gives the depth. Source: Hartley and Zisserman, Multiple View Geometry, 6.2.4."""

class DepthBuffer:
    """The nearest depth in each pixel of a view (and of a band of up to 32 pixels around it), merged by minimum: the
    order of points and chunks and the number of threads cannot be seen in the result."""

    def __init__(
        self,
        view: View,
        *,
        tolerance: float | None = None,
        max_gap: float | None = None,
        max_distance: float | None = None,
        max_incidence: float | None = None,
    ) -> None:
        """``tolerance``: what is in front by less than this part of the depth (and what follows from slope and pixel
        size) hides nothing; three sigma of the depths' own scatter if not given. ``max_gap``: the widest gap between
        points of one surface, pixels, that is taken as covered; 32. ``max_distance`` (the cloud's unit) and
        ``max_incidence`` (radians from the surface's normal, in (0, π/2]) refuse points.
        Memory: 4 bytes per pixel until finished. Raises InvalidInputError."""

    def add(self, xyz: FloatArray) -> None:
        """Puts a chunk (N, 3) in; NaN points are left out. Releases the GIL; several threads may call it at once.
        Raises InvalidInputError after :meth:`finish`."""

    def finish(self) -> VisibilityMap:
        """The frozen map; the buffer goes into it and takes no more. Raises InvalidInputError if called twice."""

class IndexBuffer:
    """The nearest point in each pixel of a view, and its index; of equal depths the lower index."""

    def __init__(self, view: View) -> None: ...
    def add(self, xyz: FloatArray, first: int = 0) -> None:
        """Puts a chunk (N, 3) in whose first point is number ``first`` of the cloud. As :meth:`DepthBuffer.add`.
        Raises InvalidInputError beyond 2³² − 1 points."""

    def images(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        """Depth (H, W), NaN where empty, and index (H, W), −1 where empty."""

    def draw(
        self, values: npt.NDArray[np.float32], *, splat: int = 1
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Depth (H, W) and value (H, W) of the nearest point, NaN where empty; ``values`` (N,) are those of all points.
        With ``splat`` (odd, 7 at most) each point is drawn as a square of so many pixels. Raises InvalidInputError."""

def sci_front(
    buffer: IndexBuffer,
    *,
    hide: bool = True,
    splat: int | None = None,
    tolerance: float | None = None,
    max_gap: float | None = None,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The points of a buffer that no surface hides: index (H, W), -1 where there is none; inverse depth (H, W), 0
    likewise; and limit (H, W): whatever has a smaller inverse depth here is hidden, 0 where nothing hides. Without
    ``hide`` every pixel keeps its nearest point. With ``splat`` (odd, 7 at most) no surfaces are found: each point is
    drawn as a square of so many pixels, and what it hides is what it is drawn over. ``tolerance`` and ``max_gap`` as in
    :class:`DepthBuffer`."""

def sci_picture(
    view: View, xyz: FloatArray, values: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Depth (H, W) and value (H, W) of the nearest point in each pixel, NaN where there is none, of points (N, 3) that
    have a value (N,) each: as an :class:`IndexBuffer` that is drawn, but in one go, which is faster and takes about as
    long whatever the order of the points. On the way they are sorted, as many at once as there are pixels, or a
    million, 12 bytes each. Raises InvalidInputError where sizes do not fit."""

def sci_gather(
    view: View,
    index: npt.NDArray[np.int64],
    station: FloatArray,
    xyz: FloatArray,
    *,
    first: int = 0,
    intensity: npt.NDArray[np.float32] | None = None,
    normals: FloatArray | None = None,
    offset: npt.NDArray[np.float32],
    value: npt.NDArray[np.float32],
    range: npt.NDArray[np.float32],
    cosine: npt.NDArray[np.float32],
) -> None:
    """Looks up those points of ``index`` (H, W) that are in this chunk (N, 3), the first of which is number ``first``.

    Written into: ``offset`` (H, W, 2), the point's true place from the pixel's centre, px; ``value`` (H, W), its
    intensity; ``range`` (H, W), its distance from ``station`` (3,), world; ``cosine`` (H, W) of the incidence there.
    Other pixels are left as they are. Raises InvalidInputError where sizes do not fit."""

def sci_fill(
    inverse_depth: npt.NDArray[np.float32],
    limit: npt.NDArray[np.float32],
    *,
    width: int = 8,
    tolerance: float = 0.006,
    wraps: bool = False,
) -> npt.NDArray[np.float32]:
    """Fills holes (zeros) of the inverse depths (H, W) up to ``width`` px wide between neighbours on one surface: the
    slope across the hole has to lie between the slopes beside it, up to ``tolerance`` of the depth. Never behind
    ``limit``."""

def sci_resample(
    values: npt.NDArray[np.float32],
    offset: npt.NDArray[np.float32],
    inverse_depth: npt.NDArray[np.float32],
    *,
    sigma: float = 0.7,
    widest: float = 4.0,
    gaps: bool = False,
) -> npt.NDArray[np.float32]:
    """Values (H, W) of points that lie ``offset`` (H, W, 2) beside their pixels' centres, brought to the centres of all
    pixels with an inverse depth: a plane through the neighbours at their true places, weighted by a Gaussian of
    ``sigma`` px, twice as wide where none is near, up to ``widest``. NaN elsewhere, and with ``gaps`` also where there
    is a point of the pixel's own."""

def fit_exponents(
    intensity: npt.NDArray[np.float32], range: npt.NDArray[np.float32], cosine: npt.NDArray[np.float32] | None = None
) -> tuple[float, float]:
    """The powers of range (-2.5 to 0) and of the cosine of incidence (0 to 1.5) that intensities (N,) follow, robustly.
    Source: the laser radar equation, Höfle and Pfeifer 2007."""

def correct_intensity(
    intensity: npt.NDArray[np.float32],
    range: npt.NDArray[np.float32],
    cosine: npt.NDArray[np.float32] | None,
    range_exponent: float,
    incidence_exponent: float,
) -> npt.NDArray[np.float32]:
    """Intensities (N,) as they would be at the median range and at normal incidence."""

def stretch_by_rank(values: npt.NDArray[np.float32], top: int) -> npt.NDArray[np.uint16]:
    """Grey values 0 to ``top`` by rank (N,): every grey is used equally often; NaN becomes 0."""

#: What became of a template, by the code in ``outcome``.
MATCH_OUTCOMES: list[str]

def resize(image: npt.NDArray[np.float32], width: int, height: int) -> npt.NDArray[np.float32]:
    """A picture (H, W) at another size, anti-aliased; the borders of the field stay, not the centres of pixels. Source:
    Mitchell and Netravali, Reconstruction filters in computer graphics, 1988."""

class Features:
    """What a picture is compared by; ``known`` (H, W) bool says which pixels take part. Immutable."""

    @staticmethod
    def channels(
        image: npt.NDArray[np.float32],
        known: npt.NDArray[np.bool_] | None = None,
        *,
        sigma_gradient: float = 0.8,
        sigma_channel: float = 1.0,
        saturation: float = 3.0,
        tuning: str = "cosine4",
    ) -> Features:
        """Oriented gradient channels, of reversed contrast the same. ``tuning`` (``cfog``, ``cosine2``, ``cosine4``) is
        how likeness falls with the angle. Sigmas in px. Raises DegenerateError for a picture without edges. Source:
        Ye et
        al., Fast and robust matching for multimodal remote sensing image registration (CFOG), TGRS 2019."""

    @staticmethod
    def grey(
        image: npt.NDArray[np.float32], known: npt.NDArray[np.bool_] | None = None, *, sigma: float = 0.8
    ) -> Features:
        """Blurred grey values."""

    @staticmethod
    def mutual_information(
        image: npt.NDArray[np.float32], known: npt.NDArray[np.bool_] | None = None, *, bins: int = 16
    ) -> Features:
        """Grey values in bins of equal population, to be compared by normalised mutual information."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...

def interest_points(
    image: npt.NDArray[np.float32],
    known: npt.NDArray[np.bool_] | None = None,
    *,
    cell: int = 32,
    per_cell: int = 2,
    border: int = 8,
    sigma_gradient: float = 0.8,
    sigma_window: float = 4.0,
    floor: float = 0.5,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """Column and row (N, 2) of the points at which a picture has edges in two directions, and how strong these are: the
    best ``per_cell`` of each ``cell`` px. Source: Shi and Tomasi 1994, after Harris and Stephens 1988."""

def match_templates(
    sci: Features,
    photo: Features,
    points: npt.NDArray[np.int64],
    *,
    half: int = 24,
    radius: int = 12,
    least_known: float = 0.5,
    least_score: float = 0.2,
    largest_second: float = 0.85,
    apart: int = 3,
    hypotheses: int = 1,
) -> dict[str, npt.NDArray[Any]]:
    """Searches the template of ``2 half + 1`` px around each of ``points`` (N, 2: column, row) of the SCI in the photo,
    at shifts up to ``radius`` px. Both pictures have the same size and the same features.

    Columns: ``template`` (M,) int64, the point's row; ``shift`` (M, 2) float64, photo minus SCI, px; ``covariance``
    (M, 3), xx xy yy, px², by least squares matching; ``score`` and ``second`` (M,) float32, of the best and the next
    peak; ``here`` (M,) float32, the score without a shift; ``outcome`` (M,) uint8, see
    :data:`MATCH_OUTCOMES`. One row for each template, or, with several ``hypotheses``, one for each peak; then
    ambiguity is left to the caller. Raises InvalidInputError."""

def score_templates(
    sci: Features,
    photo: Features,
    points: npt.NDArray[np.int64],
    *,
    half: int = 12,
    radius: int = 4,
    least_known: float = 0.5,
) -> tuple[npt.NDArray[np.float32], FloatArray]:
    """The scores of each template of :func:`match_templates` at all its shifts: (N (2 radius + 1)²,), template by
    template, row by row from the shift (-radius, -radius), NaN where too little is known; and the number of independent
    pixels (N,) behind them, 0 where the template is not known. Raises InvalidInputError."""

def masked_blur(
    image: npt.NDArray[np.float32], known: npt.NDArray[np.bool_] | None, sigma: float
) -> npt.NDArray[np.float32]:
    """A Gaussian blur of ``sigma`` px of an image (H, W) that takes known pixels alone; 0 where none is near."""

def relief(inverse_depth: npt.NDArray[np.float32], points: npt.NDArray[np.int64], half: int) -> npt.NDArray[np.float64]:
    """How far the surface within ``half`` px around each point (N, 2: column, row) departs from a plane: rms (N,),
    relative to the depth; NaN where too little is known."""

class InformationPhoto:
    """Grey values of a photo (H, W), prepared for :func:`information_distance`. Immutable."""

    def __init__(self, image: npt.NDArray[np.float32], *, bins: int = 16) -> None: ...

def information_distance(
    view: View, xyz: FloatArray, intensity: npt.NDArray[np.float32], photo: InformationPhoto
) -> tuple[float, FloatArray, int]:
    """The normalised information distance between the ranks 0 to 1 of intensities (N,) of visible points (N, 3) and the
    photo, whose size is the view's; its gradient (6,) by rotation vector on the left and projection centre; and how
    many points lie in the photo. Source: Stewart and Newman, LAPS, ICRA 2012. Raises DegenerateError below 100
    points."""

class RegressionPhoto:
    """A photo's channels (C, H, W), 1 to 4 of them, prepared for :func:`regress_patches` as cubic splines through their
    samples. Immutable."""

    def __init__(self, channels: npt.NDArray[np.float32]) -> None: ...

def regress_patches(
    photo: RegressionPhoto,
    xy: FloatArray,
    design: FloatArray,
    values: npt.NDArray[np.float32],
    members: npt.NDArray[np.int64],
    ends: npt.NDArray[np.int64],
    *,
    least_points: int = 40,
    cut: float = ...,
    order: int = 2,
    ridge: float = 1e-3,
) -> dict[str, FloatArray]:
    """Explains intensities (N,) of points, patch by patch, by a linear function of the photo's channels at their places
    ``xy`` (N, 2), px, and a polynomial of ``order`` 0 to 2 in the places; ``design`` (N, 2, U) has the places'
    derivatives by U parameters. ``members`` lists the points of all patches one after the other, ``ends`` (K,) where
    each ends. Points beyond ``cut`` robust standard deviations are left out (Tukey's biweight; by default none).

    Returns for each patch ``gradient`` (K, U) and Gauss-Newton ``information`` (K, U, U) of its log-likelihood
    ``value`` (K,), ``-n/2 log(1 - R²)``; the share R² ``explained`` (K,) of the variance; and ``points`` (K,), the sum
    of weights. A patch of fewer than ``least_points``, or one that explains nothing, has zeros. Sources: Golub and
    Pereyra 1973; Kaufman 1975. Raises InvalidInputError."""

def rank(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Ranks of values (N,), 0 to 1; equal values share the middle of theirs."""

class VisibilityMap:
    """What one photo sees of the cloud: surfaces between the points, and how deep one sees in each pixel. Immutable.

    A point is visible when it projects inside the photo, in front of the camera, in the lens's valid field, and is not
    behind a surface: a place is covered where samples lie opposite each other about it, as far apart as their own
    spacing allows, by more than a tolerance that follows depth noise, slope and spacing."""

    @property
    def view(self) -> View: ...
    def visible(self, xyz: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether the photo sees each of the points (N, 3); NaN points are not seen."""

    def depth(self) -> npt.NDArray[np.float32]:
        """The nearest depth in each pixel (H, W), NaN where there is no point."""

    def limit(self) -> npt.NDArray[np.float32]:
        """The depth in each pixel (H, W) beyond which nothing is visible; infinite where nothing hides."""

    def planes(self) -> LocalPlanes:
        """The slopes of the surfaces that the photo sees."""

class LocalPlanes:
    """Local planes of the surfaces that a view sees, fitted to windows of the finished depth buffer: up to two in each
    cell of a grid over (X, Y)/Z, told apart as in RANSAC (Fischler and Bolles 1981), from windows wide enough for the
    depths' noise. Immutable."""

    @property
    def depth_noise(self) -> float:
        """Sigma of a depth, in the cloud's unit, as the points scatter about their planes."""

    def normals(self, xyz: FloatArray) -> FloatArray:
        """Unit normals (N, 3), world frame, away from the camera, at points (N, 3); zeros where no plane passes."""

Photo = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

def colour_points(
    maps: list[VisibilityMap],
    photos: list[Photo],
    xyz: FloatArray,
    *,
    sampling: str = "bilinear",
    blend: str = "best",
    gains: FloatArray | None = None,
    normals: FloatArray | None = None,
    out_rgb: npt.NDArray[np.uint16] | None = None,
    out_source: npt.NDArray[np.uint16] | None = None,
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Colours (N, 3) for points (N, 3) from photos (H, W, 3), and the number of the photo that gave each, from 1; 0
    where no photo sees the point.

    8-bit photos give their values times 256, interpolated values keep their fraction. ``sampling`` is bilinear or
    bicubic (Keys, a = −1/2). ``blend`` is best (the best view: pixels per area of the surface, less at the photo's
    border and beside depth edges), mean (weighted) or median (weighted geometric median; with two photos the better).
    ``gains`` (V, 3) multiply the photos' channels; ``normals`` (N, 3), world frame, are used in the weights in place of
    those of the depth buffer. Given ``out_rgb`` and ``out_source`` are written into; rgb of unseen points is left as it
    is there. Points are independent of each other, so that chunks cannot be seen in the result. Raises
    InvalidInputError where photos and cameras differ in size."""

class Exposure:
    """Gains that make photos agree on points that several of them see (Brown and Lowe 2007, section 6)."""

    def __init__(self, views: int) -> None: ...
    def add(self, maps: list[VisibilityMap], photos: list[Photo], xyz: FloatArray) -> None:
        """Collects a chunk; order and threads do not matter."""

    def gains(self) -> FloatArray:
        """(V, 3), one for each photo and channel; 1 for a photo that shares no points with others."""

def scaled_xyz(records: npt.NDArray[np.uint8], scale: FloatArray, offset: FloatArray, out: FloatArray) -> None:
    """Coordinates of LAS point records (N, L), L >= 12, into ``out`` (N, 3): the three little-endian 32-bit integers at
    the start of each row, times ``scale`` (3,), plus ``offset`` (3,). Raises InvalidInputError for shorter rows."""

def patch_records(
    records: npt.NDArray[np.uint8],
    split: int,
    gap: int,
    columns: list[tuple[int, npt.NDArray[np.uint8]]],
    out: npt.NDArray[np.uint8],
) -> None:
    """Copies rows of bytes (N, L) into ``out`` (N, M): ``gap`` zero bytes are opened at byte ``split``, rows are
    filled up with zeros to M bytes, and each column (place in the new row, (N, w) bytes) is written over the result.
    Raises InvalidInputError where sizes do not fit."""

def lzf_decompress(data: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """Decompresses an LZF stream into exactly ``size`` bytes. Raises InvalidInputError when the stream is broken or
    holds more or less."""

def decode_png(data: npt.NDArray[np.uint8], max_pixels: int) -> npt.NDArray[np.uint16]:
    """A PNG with 16 bits a channel as (H, W, C) uint16, C = 1 to 4 (grey, grey + alpha, RGB, RGBA); interlaced too.
    Raises InvalidInputError when it is broken, has another depth, or more than ``max_pixels`` pixels."""

def decode_lzw(data: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """The first ``size`` bytes of a strip or tile of a TIFF that is compressed with LZW. Raises InvalidInputError when
    the stream is broken or ends before."""

class SimulatedScene:
    """A scene of exact primitives with procedural materials under sun and sky, in its own frame (metres, z up)."""

    def __init__(
        self,
        primitives: FloatArray,
        primitive_materials: npt.NDArray[np.int64],
        materials: FloatArray,
        layers: FloatArray,
        paintings: list[npt.NDArray[np.uint8]],
        lighting: FloatArray,
    ) -> None:
        """From tables. ``primitives`` (N, 12): outline, origin, u, v, surface coordinates of the origin;
        ``primitive_materials`` (N,); ``materials`` (M, 8): number of layers, gloss, translucency, relief height and
        wavelength, emission; ``layers`` (L, 16): pattern, colour (4), amount, scale (3), seed, parameters (6), those of
        each material in turn; ``paintings``: (H, W, 5) images (sRGB, near infrared, opacity); ``lighting`` (21,): see
        ``simulate.lighting``. Raises InvalidInputError with the entry that is impossible."""

    def __len__(self) -> int:
        """How many primitives it has."""

    def light(self) -> None:
        """Gathers the light of sky, lamps and surfaces now rather than at the first picture."""

    def cast(self, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int32], FloatArray]:
        """The first hit of rays (N, 3) from ``origin`` (3,): distance in units of the ray's length (N,; infinite for
        none), primitive (N,; −1 for none), unit normal towards the origin's side (N, 3; zero for none)."""

    def sees(self, origin: FloatArray, points: FloatArray, tolerance: float) -> npt.NDArray[np.bool_]:
        """Whether nothing stands between ``origin`` (3,) and points (N, 3), but for the last ``tolerance`` metres."""

    def reflectance(
        self, points: FloatArray, primitives: npt.NDArray[np.int32], footprints: FloatArray
    ) -> npt.NDArray[np.float32]:
        """Linear red, green, blue and near-infrared reflectance (N, 4) at points (N, 3) of primitives (N,) under
        footprints (N,) in metres; 0 where the primitive is −1."""

    def picture(self, view: View, first_row: int, last_row: int, samples: int) -> npt.NDArray[np.float32]:
        """Linear radiance (rows, width, 3) of the rows from ``first_row`` up to, not including, ``last_row``: the mean
        over each pixel's area, of ``samples`` rays where there are edges; 0 where the lens shows nothing."""

    def radiance_at(self, view: View, xy: FloatArray, sigma: float, own_surface: bool) -> npt.NDArray[np.float32]:
        """Linear radiance (N, 3) at pixels (N, 2) through square pixels and a Gaussian lens blur of ``sigma`` pixels;
        with ``own_surface`` of the primitive in the middle alone. NaN where the lens shows nothing."""

class Warning:
    """A doubt about an estimated view."""

    @property
    def code(self) -> str:
        """``no_redundancy``, ``few_points``, ``variance_factor``, ``large_residuals``, ``small_extent``,
        ``border_error``, ``correlation``, ``not_visible``, ``chance``, ``ambiguous``, ``few_inliers``; of a DLT also
        ``weak``, ``skew`` and ``aspect``."""

    @property
    def fatal(self) -> bool:
        """Whether the view must not be used without a person's look."""

    @property
    def message(self) -> str:
        """In words, with the figure, and what to do."""

    @property
    def value(self) -> float: ...
    @property
    def limit(self) -> float: ...

class Verdict:
    """Whether a view may be trusted."""

    @property
    def ok(self) -> bool:
        """Whether no doubt is fatal."""

    @property
    def warnings(self) -> list[Warning]: ...

class ResectionResult:
    """An estimated view, its precision, and what became of each point."""

    @property
    def view(self) -> View: ...
    @property
    def parameters(self) -> list[str]:
        """Names of the U free parameters, in the order of the covariances: ``rx ry rz`` (a small rotation vector
        applied on the left, radians), ``cx_world cy_world cz_world`` (projection centre), then camera parameters."""

    @property
    def covariance(self) -> FloatArray:
        """(U, U), a posteriori: scaled by the variance factor; with a robust loss the sandwich estimate."""

    @property
    def covariance_apriori(self) -> FloatArray:
        """(U, U) with the sigmas as they were given (1 px where they were not)."""

    @property
    def sigma0(self) -> float:
        """The square root of the variance factor, in units of the given sigma; NaN without redundancy."""

    @property
    def dof(self) -> float:
        """Coordinates in use and priors, less free parameters."""

    @property
    def residuals(self) -> FloatArray:
        """(N, 2) projected minus measured, pixels, of every point; NaN where it is not visible."""

    @property
    def status(self) -> list[str]:
        """Of every point: ``used``, ``rejected``, ``check`` or ``not visible``."""

    @property
    def rms(self) -> float:
        """Per coordinate, of the points in use, pixels."""

    @property
    def rms_x(self) -> float: ...
    @property
    def rms_y(self) -> float: ...
    @property
    def rmse(self) -> float:
        """Radial: the square root of the mean squared length."""

    @property
    def check_rms(self) -> float:
        """As ``rms``, of the check points; NaN where there are none."""

    @property
    def check_rms_x(self) -> float: ...
    @property
    def check_rms_y(self) -> float: ...
    @property
    def check_rmse(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def stop(self) -> str:
        """Why the iteration stopped."""

    @property
    def test_ratios(self) -> FloatArray | None:
        """(N,) of a robust estimate: each point's test statistic over its critical value, above 1 for blunders; NaN for
        check points."""

    @property
    def threshold(self) -> float | None:
        """Of a robust estimate: the radius of the consensus that the selection started from, pixels."""

    @property
    def samples(self) -> int | None:
        """Of a robust estimate: how many samples were drawn."""

    @property
    def log10_false_alarms(self) -> float:
        """log10 of the number of views as well supported as this one that points thrown at random over the photo would
        give. Source: Moisan and Stival 2004."""

    @property
    def border_error(self) -> float:
        """The largest predicted error at the photo's border, px per coordinate, for a point at the control points'
        median distance."""

    @property
    def centre_error(self) -> float:
        """The same in the photo's middle."""

    @property
    def second_view(self) -> View | None:
        """Another view that explains the points nearly as well; the verdict calls it ``ambiguous``."""

    @property
    def verdict(self) -> Verdict: ...

def check_parameters(view: View, *, free: list[str] = ..., priors: list[tuple[str, float, float]] = ...) -> None:
    """Raises InvalidInputError where :func:`resect` would whatever the points: a name that the camera does not have,
    free parameters or priors (name, value, sigma) that contradict each other."""

def resect(
    view: View,
    xyz: FloatArray,
    xy: FloatArray,
    *,
    free: list[str] = ...,
    sigma_xy: float | FloatArray | None = None,
    priors: list[tuple[str, float, float]] = ...,
    loss: str = "squares",
    start: str = "auto",
    check: BoolArray | None = None,
) -> ResectionResult:
    """Space resection: the view that sees the world points ``xyz`` (N, 3) at the pixels ``xy`` (N, 2).

    ``free`` names what is estimated: ``pose`` (the default), ``f`` (fx and fy in their ratio), ``aspect``, ``pp``,
    ``distortion`` (k1 k2 p1 p2, of a fisheye k1 to k4), and single parameters; the rest keeps the value of ``view``.
    ``sigma_xy``: one sigma, (N, 2) sigmas or (N, 2, 2) covariances, pixels. ``priors``: (name, value, sigma) of
    parameters known before; sigma 0 holds the parameter; ``rx ry rz`` count from the rotation of ``view``. ``loss``:
    ``squares``, ``huber``, ``cauchy`` or ``tukey``, tuned for 95 % efficiency, in units of the given sigmas, or else of
    the residuals' own median. ``start``: ``search`` finds a start by P3P on spread points whatever the pose of the
    view,
    ``given`` starts there, ``auto`` searches where the whole pose is free and the points suffice. ``check``: (N,), true
    for points that only get their residuals.

    Raises InvalidInputError (too few points, contradicting free parameters), DegenerateError (parameters that the
    points do not determine, by name) and NotConvergedError. Source: Levenberg and Marquardt on the collinearity
    equations.
    """

def resect_robust(
    view: View,
    xyz: FloatArray,
    xy: FloatArray,
    *,
    free: list[str] = ...,
    sigma_xy: float | FloatArray | None = None,
    threshold: float | None = None,
    priors: list[tuple[str, float, float]] = ...,
    loss: str = "squares",
    check: BoolArray | None = None,
    significance: float = 0.001,
    confidence: float = 0.9999,
    max_iterations: int = 100_000,
    seed: int = 0,
    unknown_focal: bool = False,
) -> ResectionResult:
    """As :func:`resect`, among blunders, which come back ``rejected``.

    What a blunder is, is decided by ``threshold`` (a fixed radius in pixels), or by a test of each point against the
    fit to the others, with the given ``sigma_xy`` or, without one, with the noise of those that agree; ``significance``
    holds for all points together. The start is found by RANSAC over P3P (over four points and a grid of focal lengths
    where ``unknown_focal``), locally optimised, with MSAC scores under a known noise and a-contrario scores otherwise.
    The same ``seed`` gives the same result at any number of threads. The final estimate is that of the points in use,
    exactly.
    Sources: Chum et al. 2003; Moisan and Stival 2004; Baarda 1968.
    """

def p3p(view: View, xyz: FloatArray, xy: FloatArray) -> list[View]:
    """All views (at most four) with the camera of ``view`` that see three world points (3, 3) at three pixels (3, 2).
    Raises DegenerateError for points on one line. Source: Persson and Nordberg 2018."""

class DltResult:
    """A DLT matrix with its residuals, covariance and verdict. Immutable."""

    @property
    def view(self) -> View: ...
    @property
    def matrix(self) -> FloatArray:
        """(3, 4), scaled so that ‖(h31 h32 h33)‖ = 1 and det M > 0: the third row times (X, 1) is the depth."""

    @property
    def parameters(self) -> list[str]:
        """h11 … h34 and the distortion terms: the order of ``covariance``."""

    @property
    def covariance(self) -> FloatArray:
        """A posteriori covariance of ``parameters``; singular in the direction of the scale."""

    @property
    def part_parameters(self) -> list[str]:
        """rx ry rz cx_world cy_world cz_world fx fy cx cy, skew, distortion: the order of ``part_covariance``."""

    @property
    def part_covariance(self) -> FloatArray: ...
    @property
    def sigma0(self) -> float: ...
    @property
    def dof(self) -> float: ...
    @property
    def residuals(self) -> FloatArray:
        """(N, 2) projected minus measured, pixels."""

    @property
    def status(self) -> list[str]:
        """For each point ``used``, ``check`` or ``not visible``."""

    @property
    def rms(self) -> float: ...
    @property
    def rms_x(self) -> float: ...
    @property
    def rms_y(self) -> float: ...
    @property
    def rmse(self) -> float: ...
    @property
    def check_rms(self) -> float: ...
    @property
    def check_rmse(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def stop(self) -> str | None: ...
    @property
    def thickness(self) -> float:
        """Smallest extent of the control points over the largest."""

    @property
    def gap(self) -> float:
        """Last singular value of the normalised equations over the last but one: 0 is exact, 1 undetermined."""

    @property
    def border_error(self) -> float: ...
    @property
    def centre_error(self) -> float: ...
    @property
    def verdict(self) -> Verdict: ...

def estimate_dlt(
    xyz: FloatArray,
    xy: FloatArray,
    width: int,
    height: int,
    *,
    method: int = 11,
    distortion: list[str] = ...,
    sigma_xy: float | FloatArray | None = None,
    check: npt.NDArray[np.bool_] | None = None,
) -> DltResult:
    """Direct Linear Transformation from control points (N, 3), world, and their pixels (N, 2).

    ``method`` 11: h34 = 1 in the frame of the centroid, iterated, then Levenberg-Marquardt on the image residuals; 12:
    the smallest singular vector of the normalised equations. ``distortion``: any of k1 k2 p1 p2 k3, as in
    :meth:`View.dlt`. ``sigma_xy``: pixels, (N, 2) or (N, 2, 2) covariances. ``check``: points that take no part. Raises
    InvalidInputError for too few points or a left-handed frame, DegenerateError for points in one plane or otherwise
    undetermined, NotConvergedError. Source: Abdel-Aziz and Karara 1971; Hartley and Zisserman, chapter 7."""

class Adjustment:
    """A view from a Gauss-Helmert adjustment, and everything that is said about it. Immutable."""

    @property
    def view(self) -> View: ...
    @property
    def names(self) -> list[str]:
        """The free parameters' names, in the order of ``values`` and ``covariance``."""

    @property
    def values(self) -> FloatArray:
        """(U,); the rotation vector is zero: it is counted from the estimate itself."""

    @property
    def covariance(self) -> FloatArray:
        """(U, U), a posteriori: scaled by the variance factor where that is estimated."""

    def dlt_covariance(self) -> tuple[list[str], FloatArray] | None:
        """Names ``h11`` … ``h34`` (and distortion terms) and their covariance, of the matrix scaled to
        ‖(h31 h32 h33)‖ = 1, singular in that direction; ``None`` where the parameters are not a DLT's."""

    def statistics(self) -> dict[str, Any]:
        """For N points given (rejected ones included), U parameters, C = 2 conditions, M = 5 observations
        (x, y, X, Y, Z):

        ``dof``, ``iterations``, ``omega`` (weighted square sum), ``variance_factor`` and its root ``sigma0`` (``None``
        without redundancy), ``scale`` (the factor in all covariances), ``scale_dof`` (``None`` where it is not
        estimated), ``variance_test`` (lower, upper, p, accepted), ``cofactor`` and ``correlations`` (U, U),
        ``high_correlations`` [(name, name, r)] above 0.95, ``smallest_eigenvalue`` of the scaled normal matrix,
        ``rejected`` [(point, statistic, critical)], ``critical``, ``noncentrality``, ``group_redundancy``
        (photo, object, priors), ``variance_components`` (factors, sigmas, correlation) or ``None``;
        ``used`` (N,), ``residuals`` (N, C) predicted - observed, ``corrections`` (N, M), ``redundancy`` (N, M),
        ``statistic`` and ``p_value`` (N,) of the test of the whole point, ``deleted`` (N, C) and
        ``deleted_covariance`` (N, C, C): the residual against the estimate without the point; ``detectable`` (N,) in
        the worst ``detectable_direction`` (N, C), ``detectable_observation`` (N, M), ``effect_on_parameters`` (N, U),
        ``effect_on_places`` (N,): the largest shift over the photo, px, by an undetected bias. NaN (effects: infinite)
        where the other points do not control a point."""

class SimilarityAdjustment:
    """As :class:`Adjustment`, for a similarity of D dimensions. Its observations are target, then source."""

    @property
    def similarity(self) -> tuple[float, FloatArray, FloatArray]:
        """Scale, rotation (D, D), translation (D,): ``target = scale * rotation @ source + translation``."""

    @property
    def names(self) -> list[str]: ...
    @property
    def covariance(self) -> FloatArray:
        """Of scale, rotation (an angle, or a small vector applied on the left) and translation; a posteriori."""

    def statistics(self) -> dict[str, Any]: ...

def adjust(
    view: View,
    xyz: FloatArray,
    xy: FloatArray,
    cov_xyz: FloatArray,
    cov_xy: FloatArray,
    free: list[str],
    *,
    dlt: bool = False,
    priors: tuple[list[str], list[float], FloatArray] | None = None,
    constraints: list[tuple[list[tuple[str, float]], float]] = ...,
    distances: list[tuple[list[float], float]] = ...,
    alpha: float = 0.001,
    power: float = 0.80,
    estimate_variance: bool = True,
    alpha_variance: float = 0.05,
    snoop: bool = True,
    variance_components: bool = False,
) -> Adjustment:
    """Adjusts a view, from its present values, to control points: world (N, 3) and pixel (N, 2) coordinates with their
    covariances (N, 3, 3) and (N, 2, 2).

    ``free``: as the command line's ``--free``; with ``dlt`` the eleven parameters of a matrix and the distortion terms
    that ``free`` names. ``priors``: names, values and covariance of free parameters (rotation: vector from the start).
    ``constraints``: [([(name, coefficient), …], value)]; ``distances``: [(point, distance of the projection centre)].
    Raises InvalidInputError, DegenerateError (naming the parameters), NotConvergedError. Sources: Pope 1972, Baarda
    1968, Förstner and Wrobel 2016.
    """

def adjust_similarity(
    source: FloatArray,
    target: FloatArray,
    cov_source: FloatArray,
    cov_target: FloatArray,
    *,
    alpha: float = 0.001,
    power: float = 0.80,
    estimate_variance: bool = True,
    alpha_variance: float = 0.05,
    snoop: bool = True,
    variance_components: bool = False,
) -> SimilarityAdjustment:
    """The similarity between point pairs (N, D), D = 2 or 3, uncertain in both frames (covariances (N, D, D)). The
    start is Umeyama's closed form. Raises as :func:`adjust`."""

def scanner_covariance(
    xyz: FloatArray, station: list[float], sigma_range: float, sigma_horizontal: float, sigma_vertical: float
) -> FloatArray:
    """Covariances (N, 3, 3) of points (N, 3) measured from a station: range in metres, angles in radians, +z up."""

def region_limit(probability: float, dimension: int, dof: int | None = None) -> float:
    """The squared Mahalanobis distance inside which ``dimension`` components lie with this probability: χ², or F times
    the dimension where the covariance was scaled with a variance factor of ``dof`` degrees of freedom."""

def exceedance(value: float, dimension: int, dof: int | None = None) -> float:
    """The probability of a larger squared Mahalanobis distance; the inverse of :func:`region_limit`."""

def predict(view: View, names: list[str], covariance: FloatArray, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of exact world points and their covariance (N, 2, 2), px², by the view's covariance (any of its
    parameters' names, or h11 … h34). NaN where not visible."""

def predicted_error_map(
    view: View, names: list[str], covariance: FloatArray, depth: float, columns: int = 25, rows: int = 19
) -> dict[str, FloatArray]:
    """What the view's covariance does over the whole photo at one depth (along the axis; range for fisheye and
    panorama), on a grid from border to border: ``xy`` (rows, columns, 2), ``xyz``, ``covariance`` (…, 2, 2),
    ``sigma_px`` (one sigma per axis), ``largest_px`` (longer half-axis), ``sigma_object`` (across the ray, the world's
    unit), ``sigma_angle`` (radians). NaN where nothing is imaged."""

def check_points(
    view: View,
    xyz: FloatArray,
    xy: FloatArray,
    cov_xyz: FloatArray,
    cov_xy: FloatArray,
    *,
    names: list[str] | None = None,
    covariance: FloatArray | None = None,
    scale: float = 1.0,
    dof: int | None = None,
) -> dict[str, Any]:
    """Points that took no part in the estimate. ``scale`` and ``dof`` are the adjustment's ``scale`` and ``scale_dof``.

    ``residuals`` (N, 2) observed - predicted with ``covariance`` (N, 2, 2), ``offsets`` (N, 3) from the point to the
    observed ray, ``statistic`` and ``p_value`` (N,), ``joint_statistic`` and ``joint_p_value`` of all together (their
    common error of the view is taken into account), ``pixels`` and
    ``object``: rms (per coordinate), rmse (radial), axes."""

def next_points(
    view: View,
    names: list[str],
    covariance: FloatArray,
    candidates: FloatArray,
    cov_xyz: FloatArray,
    cov_xy: FloatArray,
    targets: FloatArray,
    *,
    criterion: str = "mean",
    count: int = 1,
) -> dict[str, Any]:
    """Which of the ``candidates`` (N, 3) would, measured with these covariances, most reduce the predicted error over
    the ``targets`` (M, 3): its root ``mean`` square, or the ``largest``. One after the other: ``candidate``, ``xy``,
    ``mean_px`` and ``largest_px`` (before, after); and for each candidate alone ``candidates_mean_px`` and
    ``candidates_largest_px``, NaN where not in the photo. Source: Fedorov 1972."""

class SurfaceSigma:
    """The position error of colours on surfaces, for one view: ColourSigma. Immutable."""

    def __init__(
        self,
        view: View,
        names: list[str],
        covariance: FloatArray,
        *,
        sigma_image: float,
        sigma_xyz: float = 0.0,
        scanner: tuple[list[float], float, float, float] | None = None,
    ) -> None:
        """``sigma_image``: px. The points' own error is ``sigma_xyz`` in every direction (the world's unit), or that of
        a ``scanner``: station, sigma of range, horizontal and vertical angle (radians)."""

    @property
    def exact_share(self) -> float:
        """The share of the photo's table cells in which the formula is evaluated instead of interpolated."""

    def at(
        self, xyz: FloatArray, *, normals: FloatArray | None = None, planes: LocalPlanes | None = None
    ) -> npt.NDArray[np.float32]:
        """One sigma per axis on the surface (N,), in the world's unit, √(trace / 2): within 0.4 % of the formula. NaN
        outside the photo. Normals (N, 3) of any length; where there is none, or one without length, the slope is
        that of the view's own ``planes``; without either the surface is taken as facing the camera."""

    def exact(self, xyz: FloatArray, normals: FloatArray | None = None) -> FloatArray:
        """The formula itself, slowly."""

    def fill_where(
        self,
        xyz: FloatArray,
        source: npt.NDArray[np.uint16],
        number: int,
        out: npt.NDArray[np.float32],
        *,
        normals: FloatArray | None = None,
        planes: LocalPlanes | None = None,
    ) -> None:
        """As :meth:`at`, into ``out`` (N,), only where ``source`` (N,) is ``number``; rounded to eight binary places
        (0.2 %), which pack well."""

class Neighbours:
    """Points of the plane or of space, ready to be searched for the nearest ones. Immutable; batches run in parallel.

    The plane is searched by a grid of cells, clustered points and space by a kd-tree; both are exact. Between points at
    the same distance one is taken, always the same.
    """

    def __init__(self, points: FloatArray) -> None:
        """From points (N, 2) or (N, 3). Raises InvalidInputError for no point, and for a point that is not finite."""

    def __len__(self) -> int:
        """How many points there are."""

    def nearest(self, queries: FloatArray, max_distance: float = ...) -> tuple[npt.NDArray[np.int64], FloatArray]:
        """The nearest point of each query (M, 2 or 3) within a distance, which by default is infinite: indices (M,), −1
        where there is none, and distances (M,), infinite where there is none."""

    def k_nearest(
        self, queries: FloatArray, k: int, max_distance: float = ...
    ) -> tuple[npt.NDArray[np.int64], FloatArray]:
        """The ``k`` nearest points of each query within a distance, nearest first: indices (M, k), filled up with −1,
        and distances (M, k), filled up with infinity."""

    def within(
        self, queries: FloatArray, max_distance: float
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
        """All points within a distance of each query, nearest first: offsets (M + 1,), indices and distances; those of
        query ``i`` are ``offsets[i]:offsets[i + 1]``."""

class Approach:
    """The points of a cloud that lie nearest to given places, while the cloud goes by in chunks."""

    def __init__(self, places: FloatArray) -> None:
        """Places (N, 3). Raises InvalidInputError for one that is not finite."""

    def add(self, xyz: FloatArray) -> None:
        """A chunk (M, 3) goes by; points that are not finite are passed over."""

    def distances(self) -> FloatArray:
        """(N,): from each place to the nearest point, infinite where none has gone by."""

    def spacings(self) -> FloatArray:
        """(N,): how far the eight points nearest to each place are from each other, the median of what each has to its
        next one; infinite where fewer than two have gone by."""

class SimilarityFit:
    """A similarity transformation, ``target = scale * rotation @ source + translation``, and how sure it is."""

    @property
    def scale(self) -> float: ...
    @property
    def rotation(self) -> FloatArray:
        """(2, 2) or (3, 3)."""

    @property
    def translation(self) -> FloatArray: ...
    @property
    def centre_source(self) -> FloatArray:
        """The weighted centroid of the source points."""

    @property
    def centre_target(self) -> FloatArray:
        """Where the centroid goes: the shift whose covariance is given."""

    @property
    def residuals(self) -> FloatArray:
        """Target minus transformed source, (N, 2 or 3)."""

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight; NaN without redundancy."""

    @property
    def dof(self) -> int: ...
    @property
    def covariance(self) -> FloatArray:
        """A posteriori, of the scale (unless fixed), the rotation (an angle, or a small rotation vector on the left, in
        radians) and ``centre_target``."""

    @property
    def iterations(self) -> int:
        """0 for the closed form."""

    @property
    def mirrored(self) -> bool:
        """A mirror image would fit at least twice as well: one frame has a reversed axis."""

    def apply(self, points: FloatArray) -> FloatArray:
        """Source points (N, 2 or 3) to the target frame, without loss at large coordinates."""

def fit_similarity(
    source: FloatArray,
    target: FloatArray,
    *,
    weights: FloatArray | None = None,
    fixed_scale: bool = False,
    initial: tuple[float, FloatArray, FloatArray] | None = None,
) -> SimilarityFit:
    """The least-squares similarity between pairs (N, 2) or (N, 3), in closed form, or iterated from ``initial`` (scale,
    rotation, translation).

    ``weights`` (N,) are 1/σ² of a target coordinate; a weight of 0 leaves a pair out. ``fixed_scale`` holds the scale
    at 1, or at its initial value. Raises DegenerateError for too few pairs, for points in one place and, in space,
    for points on one line; NotConvergedError where the initial values are too far off. Source: Umeyama 1991.
    """

class IcpResult:
    """What an iteration of closest points ended with. Check ``accepted``: it always ends somewhere."""

    @property
    def transform(self) -> FloatArray:
        """(3, 3), homogeneous, from source to target, last element 1."""

    @property
    def names(self) -> list[str]:
        """Of the parameters: of tx, ty, rotation (radians), scale; of affine and projective ones h11 … h32."""

    @property
    def parameters(self) -> FloatArray: ...
    @property
    def covariance(self) -> FloatArray:
        """Of the parameters, a posteriori. Where the target's points lie in a line, they count across it alone."""

    @property
    def pairs(self) -> npt.NDArray[np.int64]:
        """Source and target index of each pair of the last iteration, (P, 2)."""

    @property
    def residuals(self) -> FloatArray:
        """Target minus transformed source, (P, 2)."""

    @property
    def rms(self) -> float:
        """Per coordinate: √(Σ(vx² + vy²) / 2P)."""

    @property
    def rmse(self) -> float:
        """Radial: √(Σ(vx² + vy²) / P)."""

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight: of a coordinate, unless covariances were given."""

    @property
    def distinctness(self) -> float:
        """Of how much better the source matches here than shifted aside, of how much better it could: 0 to 1."""

    @property
    def history(self) -> list[tuple[float, int, float, float]]:
        """Of each iteration: threshold, number of pairs, root mean square residual, largest shift of a corner."""

    @property
    def reason(self) -> str:
        """Why it ended: ``converged``, ``residuals large`` or ``iteration limit``."""

    @property
    def accepted(self) -> bool:
        """Whether it converged and nothing speaks against the result."""

    @property
    def findings(self) -> list[tuple[str, str, float, float]]:
        """What speaks against it: kind, sentence, figure, limit. Kinds: ``not converged``, ``ambiguous``, ``few
        paired``, ``many to one``, ``not distinct``, ``scale``, ``mirrored``."""

    def covariance_at(self, source: FloatArray) -> FloatArray:
        """Covariance (N, 2, 2) of where source points (N, 2) go, by the covariance of the transformation."""

def icp(
    source: FloatArray,
    target: FloatArray,
    *,
    motion: str = "similarity",
    metric: str = "point",
    initial: FloatArray | None = None,
    threshold: float | None = None,
    final_threshold: float | None = None,
    reduction: float = 0.8,
    mutual: bool = False,
    keep: float = 1.0,
    source_covariance: FloatArray | None = None,
    target_covariance: FloatArray | None = None,
    gate_probability: float = 0.99,
    neighbours: int = 16,
    max_iterations: int = 100,
    change_tolerance: float = 1e-4,
    residual_limit: float = 1.0,
    min_pairs: int = 10,
    scale_limit: float = 1.5,
    min_share: float = 0.25,
) -> IcpResult:
    """The transformation from points (N, 2) to points (M, 2) whose pairs are not known; lengths in pixels.

    Closest points within a threshold → least-squares transformation → apply → smaller threshold, until the change *and*
    the residuals are small. ``motion``: translation, rigid, similarity, affine, projective. ``metric``: ``point``, or
    ``line`` for the distance from the line through ``neighbours`` of the target's points (of the points where these lie
    in no line). ``initial`` (3, 3) is approximate. The threshold starts at twice the distance that 90 % of the first
    pairs keep, is multiplied by ``reduction`` after each iteration, and ends at three robust sigmas of the residuals.
    ``mutual`` keeps pairs that are the closest both ways, ``keep`` a part of them, the closest. Covariances (N, 2, 2)
    gate pairs by their Mahalanobis distance at ``gate_probability``, and weigh them. ``change_tolerance`` is of the
    source's corners, ``residual_limit`` of the root mean square. ``scale_limit`` and ``min_share`` (of source points
    that find a partner) are what a result may have without a finding.

    Raises DegenerateError when fewer than ``min_pairs`` pairs are left. Sources: Besl and McKay 1992; Chen and Medioni
    1992; Zhang 1994; Chetverikov et al. 2002.
    """

def backproject(view: View, xy: FloatArray, depth: FloatArray) -> FloatArray:
    """Pixels (N, 2) with depths (N,), as the view has them, to world points (N, 3); distortion is removed first. NaN
    where the lens images nothing and where the depth is not positive. Raises InvalidInputError."""

def invert_dlt(P: FloatArray, xy: FloatArray, depth: FloatArray, *, pseudo_inverse: bool = False) -> FloatArray:
    """Pixels (N, 2) of a DLT matrix (3, 4) of any scale, with depths (N,) in metres, to world points (N, 3).

    With the third row scaled to be metric, ``X = M⁻¹ (s x̃ − p₄)``; with ``pseudo_inverse`` the same points as ``P⁺ x̃
    + λ C̃``, λ fixed by the depth (which loses digits far from the origin). Raises DegenerateError for a camera at
    infinity. Source: Hartley and Zisserman, Multiple View Geometry, 6.2.2.
    """

@overload
def backproject_pixels(
    view: View,
    depth: npt.NDArray[np.float32] | FloatArray,
    measured: npt.NDArray[np.bool_],
    xy: FloatArray,
    *,
    subpixel: npt.NDArray[np.float32] | None = None,
    radius: float = 4.0,
    extension: float = 0.0,
    max_incidence: float = ...,
    depth_sigma: float = 0.003,
    pixel_sigma: float = 0.5,
    placement_sigma: float = ...,
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.uint8], FloatArray]: ...
@overload
def backproject_pixels(
    view: View,
    depth: npt.NDArray[np.float32] | FloatArray,
    measured: npt.NDArray[np.bool_],
    xy: None = None,
    *,
    subpixel: npt.NDArray[np.float32] | None = None,
    radius: float = 4.0,
    extension: float = 0.0,
    max_incidence: float = ...,
    depth_sigma: float = 0.003,
    pixel_sigma: float = 0.5,
    placement_sigma: float = ...,
) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray, npt.NDArray[np.uint8], FloatArray]:
    """World points behind pixels, with depths from a synthetic camera image of the same view.

    ``depth`` (H, W), float32 or float64, counts where ``measured`` (H, W); ``subpixel`` (H, W, 2) is the measured
    points' true place from their pixels' centres. For pixels ``xy`` (N, 2): points (N, 3), depths (N,), origins
    (N,) of the depth (0 none, 1 measured, 2 interpolated within one surface, 3 extended along one beside the cloud)
    and sigmas (N, 2) along the ray and, per axis, across it, in metres. Without ``xy``: of all pixels' centres that
    have a depth, and first their numbers (row * W + column).

    A surface is a plane through measured points within ``radius`` px; it is extended up to ``extension`` px, and not
    used at an incidence beyond ``max_incidence`` (radians, by default 85 degrees). No depth is made across a depth
    edge. ``depth_sigma`` (m), ``pixel_sigma`` (px, of the photo's place) and ``placement_sigma`` (px, of points in
    their pixels without ``subpixel``) are propagated. Raises InvalidInputError.
    """
