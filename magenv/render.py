"""Pictures of a state: the workspace magnified, the whole scene from above and from the side.

Lengths are in m; x points right, y (from above) or z (from the side) up. pygame is imported with the first
``Renderer``: an environment that is not drawn does without it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magenv.params import Plant, System, require
from magenv.world import LOSSES, World

if TYPE_CHECKING:
    from pygame import Surface

Floats = NDArray[np.float64]
Colour = tuple[int, int, int]

RENDER_FPS = 10
ROBOT_COLOURS: tuple[Colour, Colour] = ((0, 114, 178), (230, 159, 0))
"""Blue and orange of the Okabe-Ito palette: told apart by colour-blind eyes as well."""
PATH_SAMPLES = 201
"""Samples of the reference path in a ``Scene`` of a world."""

_SIDE_PX, _STRIP_PX, _PANEL_PX = 800, 400, 330
_DARK: tuple[Colour, Colour] = ((0, 58, 105), (140, 88, 0))
_LIGHT: tuple[Colour, Colour] = ((140, 196, 228), (246, 212, 132))
_INK, _GREY, _GRID, _PAPER, _WHITE = (40, 40, 46), (120, 120, 128), (232, 232, 236), (244, 244, 246), (255, 255, 255)
_NORTH, _SOUTH, _ALARM = (196, 40, 52), (250, 250, 250), (164, 20, 36)
_GRID_M = 0.020
_TURN = np.linspace(0.5 * math.pi, 2.5 * math.pi, 32)
"""Angles round a cap, its back half first."""
_LOSS_WORDS = {
    "deviation": "a robot is too far from its reference",
    "touch": "the robots touch",
    "wall": "a robot has reached the wall",
}


@dataclass(frozen=True, eq=False)
class Scene:
    """What a picture shows, at one time."""

    time_s: float
    duration_s: float
    """Of the whole reference."""
    robots: Floats
    """(2, 3) true x, y (m), heading (rad)."""
    reference: Floats
    """(2, 3) reference at this time: x, y (m), heading (rad)."""
    path: Floats
    """(k, 2, 2) reference of both robots over the whole duration: x, y (m)."""
    epm_positions: Floats
    """(N, 3) m."""
    epm_directions: Floats
    """(N, 3) unit moments."""
    loss: int = 0
    """Code into ``magenv.world.LOSSES``."""

    def __post_init__(self) -> None:
        require(self.robots.shape == (2, 3), "robots", "an array of shape (2, 3)", self.robots.shape)
        require(self.reference.shape == (2, 3), "reference", "an array of shape (2, 3)", self.reference.shape)
        require(self.path.shape[1:] == (2, 2), "path", "an array of shape (k, 2, 2)", self.path.shape)
        epms = self.epm_positions.shape
        require(len(epms) == 2 and epms[1] == 3, "epm_positions", "an array of shape (N, 3)", epms)
        require(self.epm_directions.shape == epms, "epm_directions", f"of shape {epms}", self.epm_directions.shape)
        require(self.loss in range(len(LOSSES)), "loss", f"from 0 to {len(LOSSES) - 1}", self.loss)

    @property
    def position_error_m(self) -> float:
        """Distance from the reference, mean of the robots, in m."""
        return float(np.hypot(*(self.robots - self.reference)[:, :2].T).mean())

    @property
    def heading_error_rad(self) -> float:
        """Angle to the reference, absolute, mean of the robots, in rad."""
        differences = (self.robots - self.reference)[:, 2]
        if not np.isfinite(differences).all():
            return math.nan
        return sum(abs(math.remainder(difference, 2 * math.pi)) for difference in differences) / 2

    @property
    def separation_m(self) -> float:
        """Distance of the robots' centres in m."""
        return math.dist(self.robots[0, :2], self.robots[1, :2])


def scene_of(world: World, row: int) -> Scene:
    """Return a copy of what there is to see of one episode; where control is lost, at that very instant."""
    trajectory = world.trajectory(row)
    time = float(world.time_s()[row])
    samples = np.linspace(0.0, trajectory.duration_s, PATH_SAMPLES)
    return Scene(
        time_s=time,
        duration_s=trajectory.duration_s,
        robots=world.robots[row, :, :3].copy(),
        reference=trajectory.at(time),
        path=np.stack([trajectory.at(sample)[:, :2] for sample in samples]),
        epm_positions=world.epms[row, :, :3].copy(),
        epm_directions=world.epms[row, :, 3:].copy(),
        loss=int(world.measurements.loss[row]),
    )


@dataclass(frozen=True)
class _View:
    """A part of the picture in which a plane is drawn to scale."""

    origin_px: tuple[float, float]
    scale: float
    """Pixels per m."""

    def px(self, points: ArrayLike) -> Floats:
        """Return the pixels (..., 2), counted downwards, of points (..., 2) in m."""
        pixels: Floats = np.asarray(self.origin_px) + np.asarray(points) * (self.scale, -self.scale)
        return pixels


class _Canvas:
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

    def text(self, words: str, at: ArrayLike, colour: Colour = _INK, height: int = 21, anchor: str = "midleft") -> None:
        """Write words whose ``anchor``, a pygame rectangle's name of a point, is ``at``."""
        image = self._shrink(self._fonts[height].render(words, True, colour), 0.5)
        x, y = np.asarray(at)
        self.surface.blit(image, image.get_rect(**{anchor: (round(x), round(y))}))


def _direction(heading: float) -> Floats:
    return np.array([math.cos(heading), math.sin(heading)])


def _pale(colour: Colour) -> Colour:
    red, green, blue = (round(0.4 * value + 0.6 * 250) for value in colour)
    return red, green, blue


class Renderer:
    """Draws scenes, with the trails of the robots since ``restart``.

    Parameters
    ----------
    system, plant : System, Plant
        Sizes of the magnets, bodies and wall.
    window : bool
        Show the scenes in a window, at most ``RENDER_FPS`` a second, instead of returning them.
    """

    def __init__(self, system: System, plant: Plant, window: bool) -> None:
        self._wall = plant.workspace_radius_m
        self._radius = plant.body.diameter_m / 2
        self._ipm = np.array([system.ipm.length_m, system.ipm.diameter_m]) / 2
        shrink = (2 / system.n_epm) ** (1 / 3)  # the EPMs share the volume of two reference magnets
        self._epm = shrink * np.array([system.reference_epm.length_m, system.reference_epm.diameter_m]) / 2
        reach = system.r_max_m + float(np.hypot(*self._epm))
        middle = _SIDE_PX + _STRIP_PX / 2
        self._zoom = _View((_SIDE_PX / 2, _SIDE_PX / 2), _SIDE_PX / 2 / (1.15 * self._wall))
        self._above = _View((middle, 30 + _PANEL_PX / 2), _PANEL_PX / 2 / reach)
        self._beside = _View((middle, 60 + 1.5 * _PANEL_PX), _PANEL_PX / 2 / reach)
        self._canvas = _Canvas((_SIDE_PX + _STRIP_PX, _SIDE_PX))
        self._draw_backdrop()
        self._backdrop = self._canvas.surface.copy()
        self._path: Floats | None = None
        self._path_backdrop = self._backdrop
        self._window = self._open = window
        self.restart()
        if window:
            import pygame

            pygame.display.init()
            pygame.display.set_mode(self._canvas.surface.get_size())
            pygame.display.set_caption("magenv")
            self._clock = pygame.time.Clock()

    def restart(self) -> None:
        """Forget the trails: a new episode begins."""
        self._trail: list[Floats] = []
        self._trail_time_s = math.nan

    def draw(self, scene: Scene) -> NDArray[np.uint8] | None:
        """Return the picture (h, w, 3), its left square the workspace; with a window, show it there and return None."""
        import pygame

        if self._window:
            self._show(scene)
            return None
        self._compose(scene)
        picture: NDArray[np.uint8] = pygame.surfarray.pixels3d(self._canvas.surface).transpose(1, 0, 2).copy()
        return picture

    def close(self) -> None:
        """Close the window; may be called again."""
        import pygame

        if self._open:
            self._open = False
            pygame.display.quit()

    def _show(self, scene: Scene) -> None:
        """Show the scene, unless the user has closed the window, or another renderer has: there is but one."""
        import pygame

        shown = pygame.display.get_surface() if self._open else None
        if shown is None:
            return
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return
        self._compose(scene)
        shown.blit(self._canvas.surface, (0, 0))
        pygame.display.flip()
        self._clock.tick(RENDER_FPS)

    def _compose(self, scene: Scene) -> None:
        """Draw the whole picture."""
        if self._path is None or not np.array_equal(self._path, scene.path):
            self._draw_path(scene.path)
        self._canvas.surface.blit(self._path_backdrop, (0, 0))
        self._draw_strip(scene)
        if np.isfinite(scene.robots).all():  # a state that has burst cannot be placed: the rest is drawn without it
            self._draw_robots(scene)
        for robot in range(2):
            self._draw_reference(self._zoom, scene.reference[robot], robot)
        self._draw_readings(scene)

    def _draw_robots(self, scene: Scene) -> None:
        """Draw the robots in all views, and in the workspace their numbers and trails."""
        canvas, zoom = self._canvas, self._zoom
        if scene.time_s != self._trail_time_s:
            self._trail.append(scene.robots[:, :2].copy())
            self._trail_time_s = scene.time_s
        if len(self._trail) > 1:
            trails = zoom.px(self._trail)
            for robot in range(2):
                canvas.line(trails[:, robot], _LIGHT[robot], 3)
        apart = scene.robots[0, :2] - scene.robots[1, :2]
        apart = 2.2 * self._radius * apart / max(float(np.hypot(*apart)), self._radius)
        for robot, away in ((0, apart), (1, -apart)):
            position, reference = scene.robots[robot], scene.reference[robot]
            canvas.text(str(robot + 1), zoom.px(position[:2] + away), _DARK[robot], 26, "center")
            canvas.thread(zoom.px([position[:2], reference[:2]]), _DARK[robot])
            self._draw_robot(zoom, position, robot)
            for view, height in ((self._above, position[1]), (self._beside, 0.0)):
                canvas.disc(view.px([position[0], height]), self._radius * view.scale, ROBOT_COLOURS[robot])

    def _draw_robot(self, view: _View, pose: Floats, robot: int) -> None:
        """Draw body, magnet and heading of a robot at ``pose`` (3,)."""
        canvas, along = self._canvas, _direction(pose[2])
        ends = view.px(pose[:2] + self._radius * np.array([[0.8], [2.4]]) * along)
        canvas.arrow(ends[0], ends[1], ROBOT_COLOURS[robot], 0.3 * self._radius * view.scale)
        canvas.disc(view.px(pose[:2]), self._radius * view.scale, ROBOT_COLOURS[robot])
        axes = np.array([along, [-along[1], along[0]]])
        for pole, colour in ((1.0, _NORTH), (-1.0, _SOUTH)):
            corners = np.array([[0.0, -1.0], [pole, -1.0], [pole, 1.0], [0.0, 1.0]]) * self._ipm
            canvas.polygon(view.px(pose[:2] + corners @ axes), colour)

    def _draw_reference(self, view: _View, pose: Floats, robot: int) -> None:
        """Draw the outline of where a robot should be."""
        self._canvas.disc(view.px(pose[:2]), self._radius * view.scale, _DARK[robot], 2)
        ends = view.px(pose[:2] + self._radius * np.array([[1.0], [2.8]]) * _direction(pose[2]))
        self._canvas.arrow(ends[0], ends[1], _DARK[robot], 2.5)

    def _draw_readings(self, scene: Scene) -> None:
        """Write time, errors, separation and the loss of control into the corners over the workspace."""
        canvas = self._canvas
        canvas.text(f"time {scene.time_s:.1f} s of {scene.duration_s:.0f} s", (16, 24), height=26)
        done = round(176 * min(scene.time_s / scene.duration_s, 1.0))
        canvas.rectangle((16, 40, 176, 8), _GRID)
        canvas.rectangle((16, 40, done, 8), _GREY)
        readings = (
            ("mean position error", f"{1e3 * scene.position_error_m:.1f} mm"),
            ("mean heading error", f"{math.degrees(scene.heading_error_rad):.1f}\N{DEGREE SIGN}"),
            ("separation", f"{1e3 * scene.separation_m:.1f} mm"),
        )
        for row, (name, value) in enumerate(readings):
            canvas.text(name, (_SIDE_PX - 92, 24 + 22 * row), _GREY, anchor="midright")
            canvas.text(value, (_SIDE_PX - 16, 24 + 22 * row), anchor="midright")
        if scene.loss:
            middle = _SIDE_PX / 2
            canvas.rectangle((round(middle) - 155, 6, 310, 52), _ALARM)
            canvas.text("CONTROL LOST", (middle, 22), _WHITE, 26, "center")
            canvas.text(_LOSS_WORDS[LOSSES[scene.loss]], (middle, 44), _WHITE, anchor="center")

    def _draw_strip(self, scene: Scene) -> None:
        """Draw the EPMs from above and from the side, and their numbers."""
        canvas, beside = self._canvas, self._beside
        for x, _, z in scene.epm_positions:
            canvas.thread(beside.px([[x, 0.0], [x, z]]), _GREY)
        for view, vertical, toward in ((self._above, 1, np.array([0, 0, 1])), (beside, 2, np.array([0, -1, 0]))):
            for k in np.argsort(scene.epm_positions @ toward, kind="stable"):
                centre, moment = scene.epm_positions[k], scene.epm_directions[k]
                pale = view is self._above and centre[2] < 0
                self._draw_epm(view, centre[[0, vertical]], moment[[0, vertical]], float(moment @ toward), pale)
            for k, centre in enumerate(scene.epm_positions):
                canvas.disc(view.px(centre[[0, vertical]]), 8, _INK)
                canvas.text(chr(ord("A") + k), view.px(centre[[0, vertical]]), _WHITE, 18, "center")
        for k, (centre, moment) in enumerate(zip(scene.epm_positions, scene.epm_directions, strict=True)):
            y = 60 + 2 * _PANEL_PX + 32 + 18 * k
            canvas.text(chr(ord("A") + k), (_SIDE_PX + 40, y), anchor="center")
            canvas.text(f"{1e3 * centre[2]:+.0f} mm", (_SIDE_PX + 190, y), anchor="midright")
            elevation = math.degrees(math.asin(min(max(moment[2], -1.0), 1.0)))
            canvas.text(f"{elevation:+.0f}\N{DEGREE SIGN}", (_SIDE_PX + 340, y), anchor="midright")

    def _draw_epm(self, view: _View, centre: Floats, axis: Floats, toward: float, pale: bool) -> None:
        """Draw a cylinder at ``centre`` (2,), its unit moment ``axis`` (2,) in the view and ``toward`` the viewer."""
        canvas, (half_length, radius) = self._canvas, self._epm
        across = float(np.hypot(*axis))
        along = axis / across if across > 1e-9 else np.array([1.0, 0.0])
        axes = np.array([along, [-along[1], along[0]]])
        cap = np.stack([abs(toward) * radius * np.cos(_TURN), radius * np.sin(_TURN)], axis=-1)

        def swept(low: float, high: float) -> Floats:
            """Return the outline of the body from one place on the axis to a higher one, in half lengths."""
            back, front = cap[: len(cap) // 2], cap[len(cap) // 2 :]
            shift = np.array([across * half_length, 0.0])
            return view.px(centre + np.concatenate([back + low * shift, front + high * shift]) @ axes)

        ends = [(_NORTH, 0.0, 1.0), (_SOUTH, -1.0, 0.0)]
        edge = _pale(_INK) if pale else _INK
        near = 1.0 if toward >= 0 else -1.0
        arrow = view.px([centre + half_length * axis, centre + (half_length + 0.1) * axis])
        if near < 0:
            canvas.arrow(arrow[0], arrow[1], edge, 3.5)
        for colour, low, high in ends[:: -int(near)]:  # the pole nearer to the viewer comes last
            colour = _pale(colour) if pale else colour
            canvas.polygon(swept(low, high), colour, edge)
        canvas.polygon(swept(near, near), colour, edge)
        if near > 0:
            canvas.arrow(arrow[0], arrow[1], edge, 3.5)

    def _draw_path(self, path: Floats) -> None:
        """Dot the reference paths (k, 2, 2) onto the backdrop, evenly along their lengths."""
        self._path = path.copy()
        canvas = self._canvas
        canvas.surface.blit(self._backdrop, (0, 0))
        for robot, colour in enumerate(ROBOT_COLOURS):
            points = self._zoom.px(path[:, robot])
            lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
            dots = np.arange(0.0, lengths[-1], 9.0)
            for dot in np.stack([np.interp(dots, lengths, points[:, axis]) for axis in range(2)], axis=-1):
                canvas.disc(dot, 1.5, colour)
        self._path_backdrop = canvas.surface.copy()

    def _draw_backdrop(self) -> None:
        """Draw what never changes: walls, grid, captions, legend and scale bars."""
        canvas, zoom = self._canvas, self._zoom
        canvas.surface.fill(_WHITE)
        canvas.rectangle((_SIDE_PX, 0, _STRIP_PX, _SIDE_PX), _PAPER)
        canvas.disc(zoom.px([0, 0]), self._wall * zoom.scale + 5, _GREY)
        canvas.disc(zoom.px([0, 0]), self._wall * zoom.scale, _WHITE)
        lines = int(self._wall / _GRID_M)
        for at in _GRID_M * np.arange(-lines, lines + 1):
            reach = math.sqrt(max(self._wall**2 - at**2, 0.0))
            canvas.thread(zoom.px([[at, -reach], [at, reach]]), _GRID)
            canvas.thread(zoom.px([[-reach, at], [reach, at]]), _GRID)
        canvas.text("workspace from above", (_SIDE_PX / 2, 24), _GREY, anchor="center")
        self._draw_scale(zoom, (_SIDE_PX - 20, _SIDE_PX - 16), _GRID_M)
        self._draw_axes((_SIDE_PX - 70, _SIDE_PX - 50), "xy")
        middle = _SIDE_PX + _STRIP_PX / 2
        panels = (
            (self._above, "xy", "external magnets from above (pale: under the plane)"),
            (self._beside, "xz", "external magnets from the side (looking along y)"),
        )
        for view, axes, title in panels:
            top = round(view.origin_px[1] - _PANEL_PX / 2)
            canvas.text(title, (middle, top - 14), anchor="center")
            canvas.rectangle((_SIDE_PX + 10, top, _STRIP_PX - 20, _PANEL_PX), _WHITE)
            self._draw_scale(view, (_SIDE_PX + _STRIP_PX - 20, top + _PANEL_PX - 10), 0.2)
            self._draw_axes((_SIDE_PX + 22, top + _PANEL_PX - 12), axes)
        canvas.disc(self._above.px([0, 0]), self._wall * self._above.scale, _GREY, 2)
        plane = self._beside.px([[-self._wall, 0], [self._wall, 0]])
        canvas.line(plane, _GREY, 3)
        canvas.text("plane", plane[1] + [8, 0], _GREY, 18)
        for x, words in ((40, "magnet"), (150, "height"), (300, "elevation of moment")):
            canvas.text(words, (_SIDE_PX + x, 60 + 2 * _PANEL_PX + 14), _GREY, anchor="center")
        self._draw_legend()

    def _draw_scale(self, view: _View, right_end: tuple[float, float], length: float) -> None:
        """Draw a scale bar of ``length`` (m) that ends at ``right_end`` (px)."""
        x, y = right_end
        left = x - length * view.scale
        self._canvas.line([[left, y - 4], [left, y], [x, y], [x, y - 4]], _INK, 2)
        self._canvas.text(f"{1e3 * length:.0f} mm", ((left + x) / 2, y - 12), height=18, anchor="center")

    def _draw_legend(self) -> None:
        """Explain the marks in the lower left corner."""
        canvas = self._canvas
        rows = ("trails", "robots", "references now", "reference paths", "magnet poles")
        top = _SIDE_PX - 22 * len(rows) + 2
        for row, words in enumerate(rows):
            canvas.text(words, (86, top + 22 * row))
        for robot, colour in enumerate(ROBOT_COLOURS):
            x = 14 + 34 * robot
            views = [_View((x + 6, top + 22 * row), 0.4 * self._zoom.scale) for row in (1, 2)]
            canvas.line([[x, top], [x + 24, top]], _LIGHT[robot], 3)
            self._draw_robot(views[0], np.zeros(3), robot)
            self._draw_reference(views[1], np.zeros(3), robot)
            for dot in (3.0, 12.0, 21.0):
                canvas.disc(np.array([x + dot, top + 66]), 1.5, colour)
        for left, pole, colour, ink in ((14, "S", _SOUTH, _INK), (43, "N", _NORTH, _WHITE)):
            canvas.rectangle((left, top + 80, 29, 16), _INK)
            canvas.rectangle((left + 1, top + 81, 27, 14), colour)
            canvas.text(pole, (left + 15, top + 89), ink, 18, "center")

    def _draw_axes(self, origin: tuple[float, float], names: str) -> None:
        """Draw two named arrows, to the right and up, from ``origin`` (px)."""
        start = np.array(origin)
        for name, way in zip(names, ([1.0, 0.0], [0.0, -1.0]), strict=True):
            self._canvas.arrow(start, start + 26 * np.array(way), _GREY, 2.0)
            self._canvas.text(name, start + 34 * np.array(way), _GREY, 18, "center")
