"""The sizes of photos whose views do not state them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from .errors import FileError
from .io.images import photo_info
from .model import Registration


def with_photo_sizes(registration: Registration, path: Path) -> Registration:
    """The registration with the sizes of photos that DLT views do not state, read from the photos."""
    views = []
    for view in registration.views:
        if view.image_size is None:
            if view.image is None:
                raise FileError(path, f"view {view.name!r} states neither its photo nor its size", "add `size`: [w, h]")
            info = photo_info(view.image)
            view = replace(view, size=(info.width, info.height))
        views.append(view)
    return replace(registration, views=tuple(views))
