"""A surface to draw on: colours, marks, and views that place lengths (m) on pixels. pygame is imported on first use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from pygame import Surface

Floats = NDArray[np.float64]
Colour = tuple[int, int, int]

INK: Colour = (40, 40, 46)


def pale(colour: Colour) -> Colour:
    """Return the colour mixed with much white."""
    red, green, blue = (round(0.4 * value + 0.6 * 250) for value in colour)
    return red, green, blue


@dataclass(frozen=True)
class View:
    """A part of the picture in which a plane is drawn to scale."""

    origin_px: tuple[float, float]
    scale: float
    """Pixels per m."""

    def px(self, points: ArrayLike) -> Floats:
        """Return the pixels (..., 2), counted downwards, of points (..., 2) in m."""
        pixels: Floats = np.asarray(self.origin_px) + np.asarray(points) * (self.scale, -self.scale)
        return pixels


class Canvas:
    """A surface and the few marks made on it; positions in pixels."""

    def __init__(self, size: tuple[int, int]) -> None:
        import pygame

        self._draw = pygame.draw
        pygame.font.init()
        self._shrink = pygame.transform.smoothscale_by
        # Twice as large and shrunk: the letters of small fonts stand on whole pixels, unevenly.
        self._fonts = {height: pygame.font.Font(None, 2 * height) for height in (18, 21, 26)}
        # Bytes in the order of an RGB array, so that reading the picture is a plain copy.
        self.surface: Surface = pygame.Surface(size, depth=24, masks=(0xFF, 0xFF00, 0xFF0000, 0))

    def disc(self, centre: Floats, radius: float, colour: Colour, width: int = 0) -> None:
        """Fill a disc, or draw a ring ``width`` wide inside its edge."""
        self._draw.aacircle(self.surface, colour, centre, radius, width)

    def polygon(self, points: Floats, colour: Colour, edge: Colour | None = None) -> None:
        """Fill a polygon (n, 2) with a smooth edge, of its own colour unless told."""
        self._draw.polygon(self.surface, colour, points)
        self._draw.aalines(self.surface, edge or colour, True, points)

    def rectangle(self, box: tuple[int, int, int, int], colour: Colour) -> None:
        """Fill a box (left, top, width, height)."""
        self.surface.fill(colour, box)

    def line(self, points: ArrayLike, colour: Colour, width: int) -> None:
        """Draw a polyline (n, 2)."""
        self._draw.lines(self.surface, colour, False, np.asarray(points), width)

    def thread(self, ends: Floats, colour: Colour) -> None:
        """Draw a smooth line, one pixel wide, between two points (2, 2)."""
        # Not ``aalines``: of two points it reads a third, beyond its memory, and its ends vary from call to call.
        self._draw.aaline(self.surface, colour, ends[0], ends[1])

    def arrow(self, start: Floats, end: Floats, colour: Colour, width: float) -> None:
        """Draw an arrow with a filled head; nothing where it would be shorter than its head."""
        along = end - start
        length = float(np.hypot(*along))
        head = 3.0 * width
        if length < head:
            return
        along = along / length
        across = np.array([-along[1], along[0]])
        neck = end - head * along
        sides = [(start, 0.5), (neck, 0.5), (neck, 1.5), (end, 0.0), (neck, -1.5), (neck, -0.5), (start, -0.5)]
        self.polygon(np.array([at + side * width * across for at, side in sides]), colour)

    def text(self, words: str, at: ArrayLike, colour: Colour = INK, height: int = 21, anchor: str = "midleft") -> None:
        """Write words whose ``anchor``, a pygame rectangle's name of a point, is ``at``."""
        image = self._shrink(self._fonts[height].render(words, True, colour), 0.5)
        x, y = np.asarray(at)
        self.surface.blit(image, image.get_rect(**{anchor: (round(x), round(y))}))
