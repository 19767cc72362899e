"""The command ``colourreg``: parse, call, print. What it does stands in the modules that it calls."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from . import __version__
from .errors import ColourregError, FileError
from .progress import terminal_bars

#: What a command ends with that was stopped by Ctrl-C, as shells have it.
INTERRUPTED = 130

if TYPE_CHECKING:
    from .model import ControlPoint, Registration

app = typer.Typer(
    name="colourreg",
    help="Puts the colours of photos onto laser scans, and says how accurate the result is.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

ToleranceOption = Annotated[
    float | None,
    typer.Option(help="What is in front by less than this part of the depth hides nothing; from the depths' noise."),
]
ReportOption = Annotated[Path | None, typer.Option(metavar="FILE", help="Write a report for people (HTML).")]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result for machines.")]


class Method(StrEnum):
    """How a view is estimated."""

    dlt = "dlt"
    resection = "resection"
    sci = "sci"


class Loss(StrEnum):
    """What large residuals count; all but squares less."""

    squares = "squares"
    huber = "huber"
    cauchy = "cauchy"
    tukey = "tukey"


class Blend(StrEnum):
    """How the colours of several photos become one."""

    best = "best"
    mean = "mean"
    median = "median"


class Sampling(StrEnum):
    """How a photo is read between its pixels."""

    bilinear = "bilinear"
    bicubic = "bicubic"


class Bits(StrEnum):
    """How finely a grey picture is told."""

    eight = "8"
    sixteen = "16"


def _write_json(path: Path | None, result: dict[str, Any] | list[Any]) -> None:
    if path is not None:
        from .io.atomic import write_text

        write_text(path, json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def _refuse_outputs(
    files: Sequence[Path | None],
    inputs: Sequence[Path | None] = (),
    registrations: Sequence[Path | None] = (),
    folder: Path | None = None,
) -> None:
    """Before any work: outputs that cannot be written, or that would take the place of an input."""
    from .io.atomic import refuse_outputs
    from .io.registration import read_registration

    named: list[Path | None] = []
    for path in registrations:
        if path is not None and any(file is not None for file in files):
            with suppress(ColourregError):  # whoever reads it next says what is wrong
                registration = read_registration(path)
                named += [registration.cloud, *(view.image for view in registration.views)]
    refuse_outputs(files, (*inputs, *registrations, *named), (folder,))


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"colourreg {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options that stand before the command."""


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for what the demo makes.")] = Path("colourreg-demo"),
    seed: Annotated[int, typer.Option(help="Another scene for another number.", min=0)] = 0,
    json_file: JsonOption = None,
) -> None:
    """The main job on simulated data whose truth is known: scene, registration, coloured cloud, figures, pictures."""
    _refuse_outputs([json_file], folder=out)
    from .demo import run_demo

    with terminal_bars() as progress:
        result = run_demo(out, seed=seed, progress=progress)
    print(result.text())
    _write_json(json_file, result.as_dict())


@app.command()
def simulate(
    scene: Annotated[str, typer.Argument(help="corner, demo, facade, room, square or trial.")],
    out: Annotated[Path, typer.Option(help="Folder for scan, photos and truth.")],
    seed: Annotated[int, typer.Option(help="Another scene for another number.", min=0)] = 0,
    photos: Annotated[int | None, typer.Option(help="How many photos.")] = None,
    size: Annotated[str | None, typer.Option(help="Width and height of the photos: 2400x1600.")] = None,
    camera: Annotated[
        str, typer.Option(help="PINHOLE, OPENCV, FULL_OPENCV, OPENCV_FISHEYE or EQUIRECTANGULAR.")
    ] = "OPENCV",
    points: Annotated[int | None, typer.Option(help="Directions that the scanner measures.")] = None,
    rotation: Annotated[
        str, typer.Option(help="The true view against the approximate one: degrees, one or three numbers (X,Y,Z).")
    ] = "0.5",
    translation: Annotated[str, typer.Option(help="The same in metres.")] = "0.02",
    principal_point: Annotated[str, typer.Option(help="Its offset in pixels: DX,DY.")] = "0,0",
    focal: Annotated[float, typer.Option(help="Error of the focal length, as a share of it.")] = 0.0,
    distortion: Annotated[str, typer.Option(help="Errors of distortion terms: k1=-0.02,p2=0.001.")] = "",
    pixel_noise: Annotated[
        float | None, typer.Option(help="Sigma of pixel noise in grey values; 0 also switches JPEG off.")
    ] = None,
    point_noise: Annotated[float, typer.Option(help="Sigma of control points in the photo, pixels.")] = 0.3,
    point_noise_3d: Annotated[float, typer.Option(help="Sigma of control points in space, metres.")] = 0.002,
    blunders: Annotated[float, typer.Option(help="Share of the control points that are blunders.")] = 0.0,
    control_points: Annotated[int, typer.Option(help="How many control points.", min=0)] = 12,
    check_points: Annotated[int, typer.Option(help="How many check points.", min=0)] = 6,
    no_scan_noise: Annotated[bool, typer.Option("--no-scan-noise", help="Perfect ranges and angles.")] = False,
    offset: Annotated[str, typer.Option(help="Where the scene lies in the world: E,N,H in metres.")] = "0,0,0",
    yaw: Annotated[float, typer.Option(help="How it is turned there, degrees.")] = 0.0,
    json_file: JsonOption = None,
) -> None:
    """A scan and photos whose truth is known, with errors put in by hand."""
    _refuse_outputs([json_file], folder=out)
    from .io.atomic import refuse_foreign_files
    from .simulate import simulate_from_text
    from .simulate.write import BEGINNING, MARK, PATTERNS

    refuse_foreign_files(out, PATTERNS, MARK, BEGINNING)

    with terminal_bars() as progress:
        files, description = simulate_from_text(
            scene,
            out,
            seed=seed,
            photos=photos,
            size=size,
            camera=camera,
            points=points,
            rotation=rotation,
            translation=translation,
            principal_point=principal_point,
            focal=focal,
            distortion=distortion,
            pixel_noise=pixel_noise,
            point_noise=(point_noise, point_noise_3d),
            blunders=blunders,
            control=(control_points, check_points),
            scan_noise=not no_scan_noise,
            offset=offset,
            yaw=yaw,
            progress=progress,
        )
    print(f"{scene}, seed {seed}: {description['points']:,} points, {len(description['photos'])} photos")
    print("\n".join(f"  {path}" for path in files))
    _write_json(json_file, description)


@app.command()
def info(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Clouds, photos, registrations, cameras, points.")
    ],
    json_file: JsonOption = None,
) -> None:
    """What clouds, photos (EXIF), registrations, cameras or lists of points hold."""
    _refuse_outputs([json_file], files, [path for path in files if path.suffix.lower() == ".json"])
    from .info import describe, lines

    described = [describe(path) for path in files]
    for path, description in zip(files, described, strict=True):
        print(f"{path}:")
        print("\n".join(f"  {line}" for line in lines(description)))
    _write_json(json_file, described)


@app.command()
def sci(
    cloud: Annotated[Path, typer.Argument(help="The laser scan.")],
    view: Annotated[Path, typer.Option(help="A registration with the view to render (JSON).")],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")],
    bits: Annotated[Bits, typer.Option(help="Of the intensity picture: 8 or 16.")] = Bits.eight,
    fill: Annotated[int, typer.Option(help="The widest hole to be filled, pixels; 0 fills none.", min=0, max=256)] = 8,
    tolerance: ToleranceOption = None,
    json_file: JsonOption = None,
) -> None:
    """Renders the synthetic camera image of a view: intensity, depth and point index."""
    _refuse_outputs([json_file], [cloud], [view], folder=out)
    from .io.clouds import read_cloud
    from .io.registration import read_registration
    from .io.sci import FILES, view_folders, write_sci
    from .photo_sizes import with_photo_sizes
    from .sci import render_sci

    registration = with_photo_sizes(read_registration(view), view)
    folders = view_folders(out, registration.views)
    there = [folder / name for folder in folders for name in FILES if (folder / name).exists()]
    _refuse_outputs(there, [cloud], [view])
    points = read_cloud(cloud)
    result = []
    for one, folder in zip(registration.views, folders, strict=True):
        image = render_sci(points, one, bits=16 if bits is Bits.sixteen else 8, fill=fill, tolerance=tolerance)
        if not image.measured.any():
            raise FileError(view, f"no point of {cloud} lies in view {one.name!r}", "check its pose, frame and unit")
        write_sci(folder, image)
        measured, seen = float(image.measured.mean()), float(image.seen.mean())
        by_range, by_incidence = image.exponents
        print(
            f"{one.name}: {100 * measured:.1f} % of the pixels measured, {100 * (seen - measured):.1f} % filled; "
            f"intensity freed of range^{by_range:.2f} and cos^{by_incidence:.2f}; wrote {folder}"
        )
        result.append({"view": one.name, "folder": str(folder), "measured": measured, "filled": seen - measured})
    _write_json(json_file, result)


@app.command()
def register(
    cloud: Annotated[Path, typer.Argument(help="The laser scan.")],
    photo: Annotated[Path, typer.Argument(help="The photo.")],
    out: Annotated[Path, typer.Option(help="The registration to write (JSON).")],
    method: Annotated[Method, typer.Option(help="How the view is estimated.")] = Method.resection,
    points: Annotated[Path | None, typer.Option(help="Control and check points (CSV: name,X,Y,Z,x,y).")] = None,
    init: Annotated[Path | None, typer.Option(help="A registration to start from.")] = None,
    camera: Annotated[Path | None, typer.Option(help="The camera (JSON), where it was calibrated.")] = None,
    free: Annotated[
        str | None, typer.Option(help="What is estimated: pose, f, aspect, pp, distortion, or parameters by name.")
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(help="Hold a parameter softly: NAME=VALUE±SIGMA (or NAME=VALUE+-SIGMA); sigma 0 holds it."),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(help="Sigma of a photo coordinate in pixels, where the list has none; else from the residuals."),
    ] = None,
    sigma_xyz: Annotated[
        float | None, typer.Option(help="Sigma of an object coordinate in metres, where the list has none; else 0.")
    ] = None,
    loss: Annotated[Loss | None, typer.Option(help="Robust loss instead of rejection and adjustment.")] = None,
    distortion: Annotated[
        str, typer.Option(help="Distortion terms beside a DLT matrix, for example k1,k2,p1,p2.")
    ] = "",
    dlt_parameters: Annotated[
        int, typer.Option(help="Approximate values by 11 (h34 = 1) or 12 (singular vector).")
    ] = 11,
    seed: Annotated[int, typer.Option(help="Of the search for blunders.", min=0)] = 0,
    report: ReportOption = None,
    force: Annotated[
        bool, typer.Option("--force", help="Write the registration even where it is not to be trusted.")
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Estimates from where, and with what camera, a photo was taken."""
    _refuse_outputs([out, json_file, report], [cloud, photo, points, init, camera], [init])
    from .register import RegisterOptions, register_photo

    chosen = RegisterOptions(
        method=method.value,
        free=tuple(name.strip() for name in free.split(",") if name.strip()) if free is not None else None,
        priors=tuple(prior or ()),
        sigma_xy=sigma,
        sigma_xyz=sigma_xyz,
        loss=loss.value if loss else None,
        distortion=tuple(name.strip() for name in distortion.split(",") if name.strip()),
        dlt_parameters=dlt_parameters,
        seed=seed,
    )
    result = register_photo(cloud, photo, points=points, init=init, camera=camera, options=chosen)
    print(result.text())
    _write_json(json_file, result.as_dict())
    if report is not None:  # a view that is not to be trusted needs looking at most
        _evaluate(result.registration, [out], None, cloud, report, None, quiet=True)
    if result.doubts and not force:
        raise FileError(
            photo,
            f"no view that can be trusted: {'; '.join(result.doubts)}",
            "no registration was written; mend the points, or keep the view all the same with --force",
        )
    result.save(out)
    print(f"wrote {out}")


@app.command()
def colourise(
    cloud: Annotated[Path, typer.Argument(help="The laser scan: LAS, LAZ, PLY or PCD.")],
    registrations: Annotated[list[Path], typer.Argument(metavar="REG.json...", help="Registrations of its photos.")],
    out: Annotated[Path, typer.Option(help="The coloured cloud: .las, .laz or .ply.")],
    blend: Annotated[Blend, typer.Option(help="How several photos become one colour.")] = Blend.best,
    sampling: Annotated[Sampling, typer.Option(help="How a photo is read between its pixels.")] = Sampling.bilinear,
    max_distance: Annotated[
        float | None, typer.Option(help="Metres from the camera beyond which nothing is coloured.")
    ] = None,
    max_sigma: Annotated[
        float | None, typer.Option(help="Metres of ColourSigma beyond which nothing is coloured.")
    ] = None,
    tolerance: ToleranceOption = None,
    level: Annotated[bool, typer.Option(help="Level exposure and white balance between photos.")] = False,
    chunk: Annotated[int, typer.Option(help="Points held at a time.", min=1000)] = 1_000_000,
    json_file: JsonOption = None,
) -> None:
    """Colours every point that a photo sees; all other points and all attributes stay as they are."""
    _refuse_outputs([out, json_file], [cloud], registrations)
    from .colourise import ColouriseOptions, colourise_file

    options = ColouriseOptions(
        blend=blend.value,
        sampling=sampling.value,
        max_distance=max_distance,
        max_sigma=max_sigma,
        tolerance=tolerance,
        level_exposure=level,
        chunk_size=chunk,
    )
    with terminal_bars() as progress:
        result = colourise_file(cloud, registrations, out, options=options, progress=progress)
    print(result.text())
    _write_json(json_file, result.as_dict())


@app.command()
def evaluate(
    registrations: Annotated[
        list[Path],
        typer.Argument(metavar="REG.json...", help="The registration; several are compared with each other too."),
    ],
    points: Annotated[
        Path | None, typer.Option(help="More points (CSV) of a single view; those that took no part are check points.")
    ] = None,
    cloud: Annotated[
        Path | None, typer.Option(help="The laser scan: compares it with the photos, and maps ColourSigma.")
    ] = None,
    report: ReportOption = None,
    json_file: JsonOption = None,
) -> None:
    """How accurate a registration is: in pixels, millimetres and milliradians, with tests and advice."""
    _refuse_outputs([report, json_file], [points, cloud], registrations)
    from .accuracy.assessment_run import read_registrations
    from .io.points import read_points

    views, files = read_registrations(registrations)
    _evaluate(views, files, read_points(points) if points else None, cloud, report, json_file)


def _evaluate(
    views: Registration,
    files: Sequence[Path],
    points: Sequence[ControlPoint] | None,
    cloud: Path | None,
    report: Path | None,
    json_file: Path | None,
    quiet: bool = False,
) -> None:
    """Assesses, prints (unless ``quiet``), and writes what was asked for."""
    from .accuracy.advice import advice
    from .accuracy.assessment_run import assess_registration, text_of

    with terminal_bars() as progress:
        assessed, photos = assess_registration(
            views, files, points, cloud, pictures=report is not None, progress=progress
        )
    if not quiet:
        print(text_of(assessed))
    if report is not None:
        from .report import write_report

        title = ", ".join(dict.fromkeys(file.stem for file in files))
        write_report(report, assessed, photos, title=title, cloud=cloud.name if cloud else None)
        print(f"wrote {report}")
    _write_json(json_file, [a.as_dict() | {"advice": list(advice(a))} for a in assessed])


@app.command()
def backproject(
    cloud: Annotated[Path, typer.Argument(help="The laser scan.")],
    registration: Annotated[Path, typer.Argument(metavar="REG.json", help="The registration of its photos.")],
    out: Annotated[Path, typer.Option(help="The cloud of the photos' pixels: .las, .laz or .ply.")],
    extension: Annotated[
        float, typer.Option(help="How far surfaces are extended beside the cloud, pixels.", min=0.0)
    ] = 0.0,
    depth_sigma: Annotated[float, typer.Option(help="Noise of the scanner along the ray, metres.", min=0.0)] = 0.003,
    pixel_sigma: Annotated[
        float, typer.Option(help="Sigma of a pixel's place by registration and photo.", min=0.0)
    ] = 0.5,
    json_file: JsonOption = None,
) -> None:
    """3D points, with colour, for the pixels of photos: measured, interpolated within one surface, or extended."""
    _refuse_outputs([out, json_file], [cloud], [registration])
    from .backproject import BackprojectOptions, backproject_file

    options = BackprojectOptions(extension=extension, depth_sigma=depth_sigma, pixel_sigma=pixel_sigma)
    result = backproject_file(cloud, registration, out, options=options)
    print(result.text())
    _write_json(json_file, result.as_dict())


@app.command()
def reproduce(
    experiment: Annotated[str, typer.Argument(help="table1, table2 or all.")] = "all",
    out: Annotated[Path | None, typer.Option(help="Folder for tables and pictures.")] = None,
    json_file: JsonOption = None,
) -> None:
    """The experiments of the paper that this package began with, beside its figures and this package's own."""
    _refuse_outputs([json_file], folder=out)
    from .experiments import reproduce as run
    from .experiments.reproduce import BEGINNING, MARK, PATTERNS
    from .io.atomic import refuse_foreign_files

    if out is not None:
        refuse_foreign_files(out, PATTERNS, MARK, BEGINNING)
    with terminal_bars() as progress:
        result = run(experiment, progress)
    print(result.text())
    if out is not None:
        print("\nwrote " + ", ".join(str(path) for path in result.write(out)))
    _write_json(json_file, result.as_dict())


for _command, _american in ((colourise, "colorize"),):
    app.command(_american, hidden=True)(_command)


def main() -> None:
    """Runs the command; what goes wrong is one line on standard error and exit code 1."""
    warnings.simplefilter("ignore", RuntimeWarning)  # of arithmetic on absurd numbers; it is no word to a user
    try:
        app()
    except ColourregError as error:
        print(f"colourreg: {error}", file=sys.stderr)
        sys.exit(1)
    except (KeyboardInterrupt, SystemExit) as end:
        # The library of the command line turns Ctrl-C into an exit of its own, without a word.
        if isinstance(end, SystemExit) and end.code != INTERRUPTED:
            raise
        print("colourreg: interrupted; no unfinished file was left", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        sys.exit(1)
    except MemoryError:
        print("colourreg: not enough memory; try a smaller --chunk or fewer photos at once", file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"colourreg: {where}{error.strerror or error}", file=sys.stderr)
        sys.exit(1)
    except Exception as error:
        if os.environ.get("COLOURREG_TRACEBACK"):
            raise
        what = " ".join(str(error).split())[:300]
        print(
            f"colourreg: a defect of colourreg itself: {type(error).__name__}: {what}; please report it with the "
            "command; COLOURREG_TRACEBACK=1 shows where it is",
            file=sys.stderr,
        )
        sys.exit(1)


if __name__ == "__main__":
    main()
