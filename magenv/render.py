"""Pictures of a state: the workspace magnified, the whole scene from above and from the side.

Lengths are in m; x points right, y (from above) or z (from the side) up. pygame is imported with the first
``Renderer``: an environment that is not drawn does without it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.canvas import INK, Canvas, Colour, View, pale
from magenv.params import Plant, System
from magenv.scene import Scene
from magenv.world import LOSSES

Floats = NDArray[np.float64]

RENDER_FPS = 10
ROBOT_COLOURS: tuple[Colour, Colour] = ((0, 114, 178), (230, 159, 0))
"""Blue and orange of the Okabe-Ito palette: told apart by colour-blind eyes as well."""

_SIDE_PX, _STRIP_PX, _PANEL_PX = 800, 400, 330
_DARK: tuple[Colour, Colour] = ((0, 58, 105), (140, 88, 0))
_LIGHT: tuple[Colour, Colour] = ((140, 196, 228), (246, 212, 132))
_GREY, _GRID, _PAPER, _WHITE = (120, 120, 128), (232, 232, 236), (244, 244, 246), (255, 255, 255)
_NORTH, _SOUTH, _ALARM = (196, 40, 52), (250, 250, 250), (164, 20, 36)
_GRID_M = 0.020
_TURN = np.linspace(0.5 * math.pi, 2.5 * math.pi, 32)
"""Angles round a cap, its back half first."""
_LOSS_WORDS = {
    "deviation": "a robot is too far from its reference",
    "touch": "the robots touch",
    "wall": "a robot has reached the wall",
}


def _direction(heading: float) -> Floats:
    return np.array([math.cos(heading), math.sin(heading)])


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
        self._zoom = View((_SIDE_PX / 2, _SIDE_PX / 2), _SIDE_PX / 2 / (1.15 * self._wall))
        self._above = View((middle, 30 + _PANEL_PX / 2), _PANEL_PX / 2 / reach)
        self._beside = View((middle, 60 + 1.5 * _PANEL_PX), _PANEL_PX / 2 / reach)
        self._canvas = Canvas((_SIDE_PX + _STRIP_PX, _SIDE_PX))
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

    def _draw_robot(self, view: View, pose: Floats, robot: int) -> None:
        """Draw body, magnet and heading of a robot at ``pose`` (3,)."""
        canvas, along = self._canvas, _direction(pose[2])
        ends = view.px(pose[:2] + self._radius * np.array([[0.8], [2.4]]) * along)
        canvas.arrow(ends[0], ends[1], ROBOT_COLOURS[robot], 0.3 * self._radius * view.scale)
        canvas.disc(view.px(pose[:2]), self._radius * view.scale, ROBOT_COLOURS[robot])
        axes = np.array([along, [-along[1], along[0]]])
        for pole, colour in ((1.0, _NORTH), (-1.0, _SOUTH)):
            corners = np.array([[0.0, -1.0], [pole, -1.0], [pole, 1.0], [0.0, 1.0]]) * self._ipm
            canvas.polygon(view.px(pose[:2] + corners @ axes), colour)

    def _draw_reference(self, view: View, pose: Floats, robot: int) -> None:
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
                under = view is self._above and centre[2] < 0
                self._draw_epm(view, centre[[0, vertical]], moment[[0, vertical]], float(moment @ toward), under)
            for k, centre in enumerate(scene.epm_positions):
                canvas.disc(view.px(centre[[0, vertical]]), 8, INK)
                canvas.text(chr(ord("A") + k), view.px(centre[[0, vertical]]), _WHITE, 18, "center")
        for k, (centre, moment) in enumerate(zip(scene.epm_positions, scene.epm_directions, strict=True)):
            y = 60 + 2 * _PANEL_PX + 32 + 18 * k
            canvas.text(chr(ord("A") + k), (_SIDE_PX + 40, y), anchor="center")
            canvas.text(f"{1e3 * centre[2]:+.0f} mm", (_SIDE_PX + 190, y), anchor="midright")
            elevation = math.degrees(math.asin(min(max(moment[2], -1.0), 1.0)))
            canvas.text(f"{elevation:+.0f}\N{DEGREE SIGN}", (_SIDE_PX + 340, y), anchor="midright")

    def _draw_epm(self, view: View, centre: Floats, axis: Floats, toward: float, under: bool) -> None:
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
        edge = pale(INK) if under else INK
        near = 1.0 if toward >= 0 else -1.0
        arrow = view.px([centre + half_length * axis, centre + (half_length + 0.1) * axis])
        if near < 0:
            canvas.arrow(arrow[0], arrow[1], edge, 3.5)
        for colour, low, high in ends[:: -int(near)]:  # the pole nearer to the viewer comes last
            colour = pale(colour) if under else colour
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

    def _draw_scale(self, view: View, right_end: tuple[float, float], length: float) -> None:
        """Draw a scale bar of ``length`` (m) that ends at ``right_end`` (px)."""
        x, y = right_end
        left = x - length * view.scale
        self._canvas.line([[left, y - 4], [left, y], [x, y], [x, y - 4]], INK, 2)
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
            views = [View((x + 6, top + 22 * row), 0.4 * self._zoom.scale) for row in (1, 2)]
            canvas.line([[x, top], [x + 24, top]], _LIGHT[robot], 3)
            self._draw_robot(views[0], np.zeros(3), robot)
            self._draw_reference(views[1], np.zeros(3), robot)
            for dot in (3.0, 12.0, 21.0):
                canvas.disc(np.array([x + dot, top + 66]), 1.5, colour)
        for left, pole, colour, ink in ((14, "S", _SOUTH, INK), (43, "N", _NORTH, _WHITE)):
            canvas.rectangle((left, top + 80, 29, 16), INK)
            canvas.rectangle((left + 1, top + 81, 27, 14), colour)
            canvas.text(pole, (left + 15, top + 89), ink, 18, "center")

    def _draw_axes(self, origin: tuple[float, float], names: str) -> None:
        """Draw two named arrows, to the right and up, from ``origin`` (px)."""
        start = np.array(origin)
        for name, way in zip(names, ([1.0, 0.0], [0.0, -1.0]), strict=True):
            self._canvas.arrow(start, start + 26 * np.array(way), _GREY, 2.0)
            self._canvas.text(name, start + 34 * np.array(way), _GREY, 18, "center")
