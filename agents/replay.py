"""Animations of recorded episodes, several controllers side by side, from records alone."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from agents.metrics import by_controller, typical
from agents.records import Record
from magenv.params import System, plant_named
from magenv.poses import to_cartesian
from magenv.render import Renderer
from magenv.scene import Scene
from magenv.world import LOSSES

PANELS = 3
"""Most controllers in one animation: the first ones of the records."""
_FRAMES = 100
_FRAME_MS = 100
_LAST_FRAME_MS = 2000
_PANEL_PX = 400
_TITLE_PX = 34
_COLOURS = 255
_INK, _PAPER, _ALARM = "#222222", "#FFFFFF", "#A41424"


def animate(records: list[Record]) -> bytes:
    """Return a GIF of one scenario: one and the same episode under each controller, frozen where control is lost.

    The episode is the typical one of the first controller.
    """
    groups = list(by_controller(records).values())
    seed = typical(groups[0]).seed
    chosen = [episode for episodes in groups for episode in episodes if episode.seed == seed][:PANELS]
    shows = [_Show(record) for record in chosen]
    frames = []
    for progress in np.linspace(0.0, 1.0, _FRAMES):
        frame = Image.new("RGB", (_PANEL_PX * len(shows), _TITLE_PX + _PANEL_PX), _PAPER)
        for column, show in enumerate(shows):
            frame.paste(show.panel(progress), (_PANEL_PX * column, 0))
        frames.append(frame)
    for show in shows:
        show.close()
    palette = _palette(frames)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    duration = [_FRAME_MS] * (_FRAMES - 1) + [_LAST_FRAME_MS]
    reduced[0].save(buffer, format="GIF", save_all=True, append_images=reduced[1:], duration=duration, loop=0)
    return buffer.getvalue()


def _palette(frames: list[Image.Image]) -> Image.Image:
    """Return an image whose colours serve all frames, so that what stands still does not flicker."""
    samples = [frames[round(at)] for at in np.linspace(0, len(frames) - 1, 5)]
    width, height = samples[0].size
    sheet = Image.new("RGB", (width, height * len(samples)))
    for row, sample in enumerate(samples):
        sheet.paste(sample, (0, height * row))
    return sheet.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT)


class _Show:
    """One recorded episode as a row of pictures."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._renderer = Renderer(System(n_epm=record.n_epm), plant_named(record.plant), window=False)
        self._centres, self._directions = to_cartesian(record.epm_pose)
        self._font = ImageFont.load_default(size=18)
        self._at = -1
        self._panel = Image.new("RGB", (0, 0))

    def panel(self, progress: float) -> Image.Image:
        """Return the picture at a share of the scenario's duration, or the last one where control has been lost."""
        at = min(round(progress * (len(self._record.reference) - 1)), len(self._record.time_s) - 1)
        if at != self._at:
            self._at = at
            self._panel = self._draw(at)
        return self._panel

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def _draw(self, at: int) -> Image.Image:
        record = self._record
        lost = not record.success and at == len(record.time_s) - 1
        picture = self._renderer.draw(self._scene(at, lost))
        assert picture is not None  # there is no window
        side = picture.shape[0]  # the workspace is the square at the left
        view = Image.fromarray(picture[:, :side]).resize((_PANEL_PX, _PANEL_PX), Image.Resampling.BOX)
        panel = Image.new("RGB", (_PANEL_PX, _TITLE_PX + _PANEL_PX), _PAPER)
        panel.paste(view, (0, _TITLE_PX))
        pen = ImageDraw.Draw(panel)
        title = record.controller
        if lost:
            title = f"{record.controller}: lost at {record.loss_time_s:.1f} s"
        elif at == len(record.reference) - 1:
            title = f"{record.controller}: held to the end"
        if lost:
            pen.rectangle((0, 0, _PANEL_PX - 1, _TITLE_PX + _PANEL_PX - 1), outline=_ALARM, width=4)
        pen.text((_PANEL_PX / 2, _TITLE_PX / 2), title, _ALARM if lost else _INK, self._font, anchor="mm")
        return panel

    def _scene(self, at: int, lost: bool) -> Scene:
        record = self._record
        instants = np.arange(len(record.reference)) / record.control_hz
        reference = np.array(
            [
                [np.interp(record.time_s[at], instants, record.reference[:, robot, axis]) for axis in range(3)]
                for robot in range(2)
            ]
        )
        return Scene(
            time_s=float(record.time_s[at]),
            duration_s=float(instants[-1]),
            robots=record.robots[at],
            reference=reference,
            path=record.reference[:, :, :2],
            epm_positions=self._centres[at],
            epm_directions=self._directions[at],
            loss=LOSSES.index(record.loss) if lost else 0,
        )
