"""Recordings on the page: made, listed, replayed, exported and downloaded, by requests of ``recording``."""

from __future__ import annotations

import asyncio
import base64
import html
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import viser

from gateway.errors import GatewayError
from gateway.recording import SkeletonArrays, open_recording
from gateway.viewer.module_table import clock_of
from gateway.viewer.step_tab import NOTHING, POOR, Ask, StepTab, set_options
from gateway.viewer.texts import segment_name, translated

LARGEST_DOWNLOAD = 1 << 30
"""Bytes: it is kept in memory on its way to the browser."""
USUAL_FORMAT = "bvh"
_MUCH_LOST_PERCENT = 2.0

Replay = Callable[[SkeletonArrays | None, str], None]
"""Shows a recording by this name in place of what comes live; None: live again. Raises ``GatewayError``."""


class TakesTab(StepTab):
    """One tab of the panel."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        ask: Ask,
        replay: Replay,
    ) -> None:
        super().__init__(server, tabs, "takes", ask)
        self._replay = replay
        self._listed: Mapping[str, Any] | None = None
        self._is_replaying = False
        self.build()

    def _add_parts(self) -> list[Any]:
        chosen = None if self._listed is None else self._take.value
        always = [
            self._button("record", self._record),
            self._button("record_stop", self._stop),
            self._button("takes_list", self._look),
            self._add_list(),
        ]
        self._of_takes = [
            self._add_choice(),
            self._button("replay", self._show),
            self._add_formats(),
            self._button_for_page("export", self._export),
            self._button_for_page("download", self._download),
        ]
        self._live = self._button("live", self._show_live)
        self._offer(chosen)
        return [*always, *self._of_takes, self._live]

    def _offer(self, chosen: str | None) -> None:
        """Show what can be done now, with that recording chosen if it is there, else the first."""
        for part in self._of_takes:
            part.visible = bool(self._files())
        self._live.visible = self._is_replaying
        set_options(self._take, tuple(self._files()) or (NOTHING,), chosen)

    def _add_list(self) -> Any:
        content = "" if self._listed is None else takes_list(self._listed, self._language)
        self._list = self._server.gui.add_html(content)
        return self._list

    def _add_choice(self) -> Any:
        self._take = self._server.gui.add_dropdown(
            self._translated("take"), tuple(self._files()) or (NOTHING,)
        )
        return self._take

    def _add_formats(self) -> Any:
        formats = tuple((self._listed or {}).get("formats", ())) or (USUAL_FORMAT,)
        self._format = self._server.gui.add_dropdown(self._translated("format"), formats)
        return self._format

    def _files(self) -> dict[str, Mapping[str, Any]]:
        """Return what is listed, by file name."""
        listed: Sequence[Mapping[str, Any]] = (self._listed or {}).get("recordings", ())
        return {take["file"]: take for take in listed}

    async def _record(self) -> str:
        answer = await self._ask("recording", "start", {})
        return self._translated("records_to", file=Path(str(answer["file"])).name)

    async def _stop(self) -> str:
        answer = await self._ask("recording", "stop", {})
        await self._look()
        return self._translated(
            "recorded", file=Path(str(answer["file"])).name, clock=clock_of(answer["seconds"])
        )

    async def _look(self) -> str:
        self._listed = await self._ask("recording", "list", {})
        self._list.content = takes_list(self._listed, self._language)
        self._offer(self._take.value)
        self._format.options = tuple(self._listed["formats"])
        return self._translated("takes_found", count=len(self._files()), folder=self._listed["folder"])

    def _chosen(self) -> Mapping[str, Any]:
        """Return the recording that is chosen. Raises ``GatewayError`` where none is."""
        if (take := self._files().get(self._take.value)) is None:
            raise GatewayError(self._translated("no_take", list=self._translated("takes_list")))
        return take

    async def _show(self) -> str:
        take = self._chosen()
        with tempfile.TemporaryDirectory(prefix="mocap-page-") as folder:
            for name in take["files"]:
                (Path(folder) / name).write_bytes(await self._read(name))
            # In a thread, as the page goes on meanwhile.
            arrays = await asyncio.to_thread(_arrays_of, Path(folder) / take["file"])
        self._replay(arrays, take["file"])
        self._is_replaying = True
        self._offer(take["file"])
        return self._translated("replays", file=take["file"], live=self._translated("live"))

    async def _show_live(self) -> str:
        self._replay(None, "")
        self._is_replaying = False
        self._offer(self._take.value)
        return self._translated("is_live")

    async def _export(self, client: viser.ClientHandle | None) -> str:
        take, to = self._chosen(), self._format.value
        self._show_text(self._translated("exports", file=take["file"], to=to))
        made = await self._ask("recording", "export", {"file": take["file"], "to": to})
        await self._send(client, str(made["file"]))
        await self._look()
        made_text = self._translated(
            "exported", file=made["file"], frames=made["frames"], rate=f"{made['rate_hz']:g}"
        )
        guessed = [name for name, count in made["interpolated"].items() if count == made["frames"]]
        if not guessed:
            return made_text
        named = ", ".join(segment_name(self._language, name) for name in guessed)
        return f"{made_text}; {self._translated('never_known', segments=named)}"

    async def _download(self, client: viser.ClientHandle | None) -> str:
        take = self._chosen()
        for name in take["files"]:
            await self._send(client, name)
        return self._translated("downloaded", file=take["file"])

    async def _send(self, client: viser.ClientHandle | None, name: str) -> None:
        """Send a file to the page that asked for it."""
        if client is not None:
            client.send_file_download(name, await self._read(name), save_immediately=True)

    async def _read(self, name: str) -> bytes:
        """Return a whole file of the gateway's folder. Raises ``GatewayError``."""
        found = bytearray()
        size = 1
        while len(found) < size:
            # A message to the broker must not be as large as a recording, so the file comes in pieces.
            piece = await self._ask("recording", "read", {"file": name, "offset": len(found)})
            data, size = base64.b64decode(piece["data"]), int(piece["bytes"])
            if size > LARGEST_DOWNLOAD:
                raise GatewayError(
                    self._translated("too_large", file=name, folder=(self._listed or {})["folder"])
                )
            if not data:
                break
            found += data
            self._show_text(
                self._translated("reads", file=name, percent=f"{100 * len(found) / max(size, 1):.0f}")
            )
        return bytes(found)


def _arrays_of(path: Path) -> SkeletonArrays:
    return open_recording(path).skeleton_arrays()


def takes_list(listed: Mapping[str, Any], language: str) -> str:
    """Return the answer of ``recording/list`` as HTML: picture, date, duration, size and losses."""
    cards = "".join(_card(take, language) for take in listed["recordings"])
    problems = "".join(
        f'<div style="color:{POOR}">{html.escape(problem)}</div>' for problem in listed["problems"]
    )
    free = listed.get("free_mb")
    room = (
        ""
        if free is None
        else f"<div>{html.escape(translated(language, 'room', gb=f'{free / 1e3:.1f}'))}</div>"
    )
    return f'<div style="padding:0 12px 4px;font-size:12px">{room}{problems}{cards}</div>'


def _card(take: Mapping[str, Any], language: str) -> str:
    loss = take["loss_percent"]
    lost = "" if loss is None else translated(language, "take_lost", percent=f"{loss:.2f}")
    colour = POOR if loss is not None and loss > _MUCH_LOST_PERCENT else "inherit"
    when = datetime.fromtimestamp(take["begun_utc_ns"] * 1e-9, UTC)
    size = f"{clock_of(take['duration_s'])} · {take['bytes'] / 1e6:.1f} MB"
    more = [*take["exports"], *([take["defect"]] if take["defect"] else [])]
    return (
        '<div style="display:flex;gap:8px;padding:3px 0;border-top:1px solid rgba(128,128,128,.4)">'
        f"{thumbnail(take['outline'], take['file'])}"
        f'<div style="min-width:0;overflow-wrap:anywhere"><b>{html.escape(take["file"])}</b><br>'
        f"{when:%Y-%m-%d %H:%M:%S} UTC<br>{size} · "
        f'<span style="color:{colour}">{html.escape(lost)}</span>'
        f"<br>{html.escape(', '.join(more))}</div></div>"
    )


def thumbnail(outline: Sequence[Sequence[float]], name: str) -> str:
    """Return the body half-way through a recording as a small SVG; an empty frame where it is unknown."""
    points = [(x, y) for x0, y0, x1, y1 in outline for x, y in ((x0, y0), (x1, y1))]
    # SVG's y points down.
    top = max((y for _, y in points), default=1.0) + 0.1
    height = max(top - min((y for _, y in points), default=0.0) + 0.1, 0.5)
    lines = "".join(
        f'<line x1="{x0:.3f}" y1="{top - y0:.3f}" x2="{x1:.3f}" y2="{top - y1:.3f}"/>'
        for x0, y0, x1, y1 in outline
    )
    return (
        f'<svg role="img" aria-label="{html.escape(name, quote=True)}" width="44" height="64" '
        f'viewBox="{-0.5 * height * 0.69:.3f} 0 {height * 0.69:.3f} {height:.3f}" '
        'style="flex:none;background:rgba(128,128,128,.15);border-radius:4px">'
        '<g stroke="currentColor" stroke-width="0.05" stroke-linecap="round">'
        f"{lines}</g></svg>"
    )
