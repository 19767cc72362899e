"""Painted textures: posters, signs, pictures, what is seen through windows.

Each is (H, W, 5) uint8: sRGB, near-infrared reflectance, opacity. Printing inks other than carbon black are as good as
transparent in near infrared, so that a poster is a blank sheet to the scanner.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from .materials import Painting

_WORDS = ["JAZZ", "CIRCUS", "KONZERT", "EXPO", "THEATER", "CINEMA", "SUMMER", "OPERA", "MARKET", "FESTIVAL", "MUSEUM"]
_SHOPS = ["BAKERY", "BOOKS", "CAFE ROMA", "PHARMACY", "FLOWERS", "OPTICIAN", "TAILOR", "WINE & CO"]
_PALETTES = [
    ["#f4d35e", "#ee964b", "#f95738", "#0d3b66", "#faf0ca"],
    ["#264653", "#2a9d8f", "#e9c46a", "#f4a261", "#e76f51"],
    ["#f1faee", "#e63946", "#1d3557", "#457b9d", "#a8dadc"],
    ["#fefae0", "#606c38", "#283618", "#dda15e", "#bc6c25"],
    ["#fdf0d5", "#c1121f", "#003049", "#669bbc", "#780000"],
    ["#ffffff", "#ffbe0b", "#fb5607", "#8338ec", "#3a86ff"],
]


def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(size, 6))


def _stack(picture: Image.Image, nir: npt.NDArray[np.float64] | float, opacity: float = 1.0) -> Painting:
    rgb = np.asarray(picture.convert("RGB"))
    out = np.empty((*rgb.shape[:2], 5), np.uint8)
    out[..., :3] = rgb
    out[..., 3] = np.clip(np.asarray(nir) * 255.0 + 0.5, 0, 255)
    out[..., 4] = round(opacity * 255)
    return out


def _paper(shape: tuple[int, ...], rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Near-infrared reflectance of paper: even but for a few wrinkles."""
    coarse = rng.normal(0.78, 0.02, (shape[0] // 40 + 2, shape[1] // 40 + 2)).astype(np.float32)
    smooth = Image.fromarray(coarse).resize((shape[1], shape[0]), Image.Resampling.BICUBIC)
    return np.asarray(smooth, dtype=np.float64)


def poster(rng: np.random.Generator, width: float, height: float, texel: float = 0.00125) -> Painting:
    """A printed poster of this size in metres."""
    w, h = max(round(width / texel), 16), max(round(height / texel), 16)
    palette = list(_PALETTES[int(rng.integers(len(_PALETTES)))])
    rng.shuffle(palette)
    picture = Image.new("RGB", (w, h), palette[0])
    draw = ImageDraw.Draw(picture)
    kind = int(rng.integers(4))
    if kind == 0:
        for _ in range(9):
            r = float(rng.uniform(0.08, 0.35)) * w
            x, y = float(rng.uniform(0, w)), float(rng.uniform(0.15 * h, 0.8 * h))
            draw.ellipse([x - r, y - r, x + r, y + r], fill=palette[int(rng.integers(1, 5))])
    elif kind == 1:
        for i in range(12):
            top = 0.12 * h + i * 0.055 * h
            draw.polygon(
                [(0, top), (w, top - 0.2 * h), (w, top - 0.2 * h + 0.03 * h), (0, top + 0.03 * h)],
                fill=palette[1 + i % 4],
            )
    elif kind == 2:
        centre = (float(rng.uniform(0.3, 0.7)) * w, 0.45 * h)
        for i in range(24):
            a = 2 * np.pi * np.array([i, i + 0.5]) / 24
            tip = [(centre[0] + 2 * h * np.cos(t), centre[1] + 2 * h * np.sin(t)) for t in a]
            draw.polygon([centre, *tip], fill=palette[1 + i % 2])
        r = 0.22 * w
        draw.ellipse([centre[0] - r, centre[1] - r, centre[0] + r, centre[1] + r], fill=palette[3])
    else:
        art = Image.fromarray(landscape(rng, w, round(0.6 * h))[..., :3])
        picture.paste(art, (0, round(0.14 * h)))
    ink = "#111111" if sum(Image.new("RGB", (1, 1), palette[0]).getpixel((0, 0))) > 380 else "#f8f6f0"  # type: ignore[arg-type]
    word = str(rng.choice(_WORDS))
    size = 1.55 * w / max(len(word), 4)
    draw.text((0.06 * w, 0.02 * h), word, fill=ink, font=_font(min(size, 0.16 * h)))
    draw.rectangle([0, 0.86 * h, w, h], fill=palette[4])
    for i in range(3):
        names = f"{rng.choice(_WORDS).title()} {rng.choice(_WORDS).title()}"
        line = f"{int(rng.integers(1, 29))}.{int(rng.integers(1, 13)):02d}.  {names}"
        draw.text((0.06 * w, (0.87 + 0.04 * i) * h), line, fill="#151515", font=_font(0.034 * h))
    draw.rectangle([0, 0, w - 1, h - 1], outline="#f6f4ee", width=max(w // 60, 2))
    return _stack(picture, _paper((h, w), rng))


def shop_sign(rng: np.random.Generator, width: float, height: float, texel: float = 0.003) -> Painting:
    """A shop's name on a board: the letters are film, half visible in near infrared."""
    w, h = max(round(width / texel), 32), max(round(height / texel), 16)
    ground, letters = [
        ("#1e3a2b", "#e8d9a0"), ("#5b1a1a", "#f2e6cf"), ("#1b2a41", "#f4f1de"), ("#efe9dc", "#7a1f1f")
    ][int(rng.integers(4))]  # fmt: skip
    picture = Image.new("RGB", (w, h), ground)
    mask = Image.new("L", (w, h), 0)
    word = str(rng.choice(_SHOPS))
    font = _font(0.62 * h)
    box = ImageDraw.Draw(mask).textbbox((0, 0), word, font=font)
    at = ((w - (box[2] - box[0])) / 2 - box[0], (h - (box[3] - box[1])) / 2 - box[1])
    ImageDraw.Draw(mask).text(at, word, fill=255, font=font)
    picture.paste(Image.new("RGB", (w, h), letters), (0, 0), mask)
    draw = ImageDraw.Draw(picture)
    edge = max(h // 16, 2)
    draw.rectangle([edge, edge, w - edge - 1, h - edge - 1], outline=letters, width=max(edge // 2, 1))
    return _stack(picture, 0.42 + 0.12 * np.asarray(mask, dtype=np.float64) / 255.0)


def number_plate(text: str, width: float, height: float, texel: float = 0.001) -> Painting:
    """An enamelled house number."""
    w, h = round(width / texel), round(height / texel)
    picture = Image.new("RGB", (w, h), "#1d3f87")
    draw = ImageDraw.Draw(picture)
    draw.rectangle([6, 6, w - 7, h - 7], outline="#ffffff", width=4)
    draw.text((w / 2, h / 2), text, fill="#ffffff", font=_font(0.7 * h), anchor="mm")
    return _stack(picture, 0.5)


def landscape(rng: np.random.Generator, w: int, h: int) -> Painting:
    """A painted landscape: sky, ranges of hills, a sun, brush strokes."""
    y, x = np.mgrid[0:h, 0:w].astype(np.float64)
    y, x = y / h, x / max(w, 1)
    top, low = rng.uniform(0.2, 0.9, 3), rng.uniform(0.5, 1.0, 3)
    rgb = top + (low - top) * y[..., None]
    cx, cy = rng.uniform(0.2, 0.8), rng.uniform(0.1, 0.35)
    rgb[(x - cx) ** 2 + ((y - cy) * h / w) ** 2 < 0.006] = [1.0, 0.92, 0.6]
    for k in range(5):
        a = rng.uniform(0, 6, 4)
        ridge = (
            0.35 + 0.12 * k + 0.06 * np.sin(5 * x + a[0]) + 0.03 * np.sin(13 * x + a[1]) + 0.015 * np.sin(31 * x + a[2])
        )
        rgb[y > ridge] = rng.uniform(0.1, 0.75, 3) * (1.0 - 0.12 * k)
    strokes = rng.normal(0, 1, (h // 3 + 1, w // 9 + 1)).astype(np.float32)
    texture = np.asarray(Image.fromarray(strokes).resize((w, h), Image.Resampling.BICUBIC))
    rgb = np.clip(rgb * (1 + 0.10 * texture[..., None]), 0, 1)
    picture = Image.fromarray((rgb * 255).astype(np.uint8))
    return _stack(picture, np.clip(0.55 + 0.06 * texture, 0, 1))


def abstract(rng: np.random.Generator, w: int, h: int) -> Painting:
    """An abstract painting of rectangles and circles."""
    palette = _PALETTES[int(rng.integers(len(_PALETTES)))]
    picture = Image.new("RGB", (w, h), palette[0])
    draw = ImageDraw.Draw(picture)
    for _ in range(14):
        x, y = rng.uniform(-0.1, 0.9) * w, rng.uniform(-0.1, 0.9) * h
        dx, dy = rng.uniform(0.08, 0.5) * w, rng.uniform(0.05, 0.4) * h
        shape = draw.ellipse if rng.random() < 0.35 else draw.rectangle
        shape([x, y, x + dx, y + dy], fill=palette[int(rng.integers(1, 5))])
    for _ in range(5):
        x0, y0, x1, y1 = rng.uniform(0, 1, 4) * [w, h, w, h]
        draw.line([x0, y0, x1, y1], fill="#101010", width=max(w // 70, 2))
    return _stack(picture, 0.6)


def interior(rng: np.random.Generator, width: float, height: float, texel: float = 0.01) -> Painting:
    """What is seen through a window from outside: a dark room, curtains, perhaps a plant or a lamp."""
    w, h = max(round(width / texel), 8), max(round(height / texel), 8)
    y, x = np.mgrid[0:h, 0:w].astype(np.float64)
    y, x = y / h, x / w
    rgb = np.array([0.10, 0.11, 0.12]) * (1.0 + 0.9 * (1 - y))[..., None]
    rgb[(y > 0.75) & (np.abs(x - rng.uniform(0.2, 0.8)) < 0.2)] = rng.uniform(0.08, 0.3, 3)
    if rng.random() < 0.75:
        tint = np.array(
            [[0.85, 0.83, 0.78], [0.8, 0.74, 0.62], [0.62, 0.66, 0.7], [0.72, 0.5, 0.42]][int(rng.integers(4))]
        )
        reach = rng.uniform(0.12, 0.42)
        folds = 0.75 + 0.25 * np.sin(2 * np.pi * x * rng.uniform(9, 16) + 0.8 * np.sin(5 * y))
        drawn = (x < reach * (0.75 + 0.25 * y)) | (x > 1 - reach * (0.75 + 0.25 * y))
        rgb[drawn] = (tint * folds[..., None])[drawn] * 0.55
    if rng.random() < 0.4:
        blind = y < rng.uniform(0.15, 0.6)
        slats = 0.7 + 0.3 * np.sin(2 * np.pi * y * height / 0.05)
        rgb[blind] = (np.array([0.7, 0.69, 0.66]) * slats[..., None])[blind] * 0.6
    picture = Image.fromarray((np.clip(rgb, 0, 1) * 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(1))
    return _stack(picture, 0.06 + 0.25 * rgb.mean(axis=2))


def book_spine(rng: np.random.Generator, width: float, height: float, texel: float = 0.001) -> Painting:
    """The back of a book."""
    w, h = max(round(width / texel), 8), max(round(height / texel), 40)
    ground = tuple(int(c) for c in rng.integers(30, 225, 3))
    ink = "#f5efdc" if sum(ground) < 380 else "#1b1b1b"
    picture = Image.new("RGB", (h, w), ground)
    draw = ImageDraw.Draw(picture)
    if rng.random() < 0.6:
        a = rng.uniform(0.05, 0.2)
        draw.rectangle(
            [a * h, 0, (a + rng.uniform(0.02, 0.1)) * h, w], fill=tuple(int(c) for c in rng.integers(20, 240, 3))
        )
    title = f"{rng.choice(_WORDS).title()} {rng.choice(_WORDS).title()}"
    draw.text((0.6 * h, w / 2), title, fill=ink, font=_font(0.55 * w), anchor="mm")
    return _stack(picture.rotate(-90, expand=True), float(rng.uniform(0.45, 0.75)))


def clock_face(size: float, texel: float = 0.001) -> Painting:
    """A wall clock."""
    n = round(size / texel)
    picture = Image.new("RGB", (n, n), "#f4f2ec")
    draw = ImageDraw.Draw(picture)
    c = n / 2
    for i in range(60):
        a, long = np.pi * i / 30, 0.1 if i % 5 == 0 else 0.04
        p = [
            c + (0.46 - long) * n * np.sin(a),
            c - (0.46 - long) * n * np.cos(a),
            c + 0.46 * n * np.sin(a),
            c - 0.46 * n * np.cos(a),
        ]
        draw.line(p, fill="#111111", width=max(n // (40 if i % 5 == 0 else 120), 1))
    for a, length, width in ((0.9, 0.28, 30), (4.3, 0.4, 50)):
        draw.line([c, c, c + length * n * np.sin(a), c - length * n * np.cos(a)], fill="#111111", width=n // width)
    return _stack(picture, 0.7)
