"""The sizes of photos: read where views do not state them, compared where they do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from .errors import DegenerateError, FileError, InvalidInputError
from .io.images import photo_info
from .model import Registration


def with_photo_sizes(registration: Registration, path: Path) -> Registration:
    """The registration with the sizes of photos that DLT views do not state, read from the photos.

    Sizes that are stated are those of the photos that are there. Raises FileError.
    """
    views = []
    for view in registration.views:
        if view.image_size is None:
            if view.image is None:
                raise FileError(path, f"view {view.name!r} states neither its photo nor its size", "add `size`: [w, h]")
            info = photo_info(view.image)
            view = replace(view, size=(info.width, info.height))
        elif view.image is not None and view.image.is_file():
            info = photo_info(view.image)
            if view.image_size != (info.width, info.height):
                wanted = "{} x {}".format(*view.image_size)
                raise FileError(
                    view.image,
                    f"has {info.width} x {info.height} pixels, its camera in {path} {wanted}",
                    "use the photo that was registered, not a scaled or turned copy",
                )
        try:
            _ = view.core
        except (DegenerateError, InvalidInputError) as error:
            raise FileError(path, f"view {view.name!r}: {error}") from error
        views.append(view)
    return replace(registration, views=tuple(views))
