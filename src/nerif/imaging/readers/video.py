"""Films of video formats (.avi, .mp4, .mov, .mkv), by PyAV (FFmpeg): brightness as stored, exact to the frame."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.installation import optional
from nerif.imaging.readers.frames import FilmFrames, check_size

__all__ = ["VideoFrames"]

LOSSY, LOSSLESS, REORDERED = 2, 4, 8  # properties of a codec; some have both of the first two
CONTAINERS = {"format_whitelist": "avi,mov,matroska", "protocol_whitelist": "file"}
"""For FFmpeg, which also reads scripts and playlists that name other files and addresses."""
LIMITED_RANGE, FULL_RANGE = 1, 2
LIMITED_WHITE = 235  # of 8 bit; black is 16 (ITU-R BT.601)

Packet = tuple[int | None, int | None, bool]
"""Time of presentation, time of decoding, and whether it is a key frame."""


class VideoFrames(FilmFrames):
    """A film; the decoder stays where it last read, so that successive frames are decoded once.

    A frame is found by its time of presentation, from the key frame before it. AVI has no such times: where its codec
    reorders frames, they are counted from the first one.
    """

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        self._film: Any = None
        self._decoded: Iterator[Any] = iter(())
        self._next = 0
        self._lock = threading.Lock()  # of the decoder
        av = _av()
        try:
            with av.open(f"file:{path}", metadata_errors="replace", options=CONTAINERS) as film:
                stream: Any = next(iter(film.streams.video), None)
                context = stream and stream.codec_context
                if context is None or not context.pix_fmt:
                    raise InputError("expected a film that FFmpeg can decode; export the frames as TIFF", field=name)
                check_size((context.height, context.width), path, name=name)
                tick = float(stream.time_base)
                self._codec, properties = context.codec.name, int(context.codec.properties)
                self._rate, self._expected = float(stream.average_rate or 0), stream.frames
                packets = _packets(film, stream, bool(properties & REORDERED))
                is_ordered = not (properties & REORDERED and film.format.name == "avi")
                pixels, range_ = av.VideoFormat(context.pix_fmt, 16, 16), context.color_range
        except av.FFmpegError as error:
            text = f"cannot be read as a film, truncated or damaged? ({error.strerror}); copy or export it again"
            raise InputError(text, field=name) from None
        if not packets:
            raise InputError("expected at least one frame, got none; export it again", field=name)
        self._length, self._is_lossy, self._is_lossless = len(packets), properties & LOSSY, properties & LOSSLESS
        stamps = sorted({pts for pts, _, _ in packets if pts is not None})
        self._stamps = np.array(stamps) if is_ordered and len(stamps) == len(packets) else None
        keys = {0: 0}  # times to seek, by the number of the frame
        if self._stamps is not None:
            numbers = {pts: i for i, pts in enumerate(stamps)}
            keys |= {numbers[pts]: pts if dts is None else dts for pts, dts, is_key in packets if pts and is_key}
        self._keys, self._key_numbers = keys, np.array(sorted(keys))
        self._set_times(tick)
        bits = pixels.components[0].bits
        self.metadata_bits = bits if 8 <= bits <= 16 else None
        is_limited = range_ == LIMITED_RANGE or (range_ != FULL_RANGE and len(pixels.components) > 2)
        if self.metadata_bits and is_limited and not (pixels.is_rgb or pixels.has_palette):
            self.white = LIMITED_WHITE << (bits - 8)

    def _set_times(self, tick: float) -> None:
        """Set the times from those of presentation, or from the frame rate where it is constant to a tick."""
        times = np.arange(self._length) / self._rate if self._rate else None
        if self._stamps is not None:
            stamps = (self._stamps - self._stamps[0]) * tick
            if times is None or np.abs(stamps - times).max() > tick:
                times = stamps
        self.times = times

    @cached_property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        notes = []
        if self._is_lossy:
            often = ", as a rule with loss" if self._is_lossless else " with loss"
            notes.append(f"compressed{often} ({self._codec}), which adds errors; better export it without loss")
        if self._expected > len(self):
            notes.append(f"has {len(self)} of the {self._expected} frames of its header; truncated? Copy it again")
        if self._rate:
            notes.append(f"times by its {self._rate:g} frames per second; if it was recorded faster, set --frame-rate")
        with suppress(Exception), self._lock:  # reported when the frame is read
            if self._frame(0).interlaced_frame:
                notes.append("interlaced: its even and uneven rows show different instants; record progressive frames")
        return tuple(f"{self._name}: {note}" for note in notes)

    def __getstate__(self) -> dict[str, Any]:
        """State for another process: all but the decoder."""
        return {key: value for key, value in self.__dict__.items() if key not in ("_film", "_decoded", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _film=None, _decoded=iter(()), _lock=threading.Lock())

    def load(self, i: int) -> np.ndarray:
        with self._lock:
            frame = self._frame(i)
        if frame.is_corrupt:
            raise ValueError("its data are incomplete")
        return _brightness(frame, self.name(i))

    def _frame(self, i: int) -> Any:
        """Decode up to frame `i`: from where the decoder is, from the key frame before it, or from the first one."""
        key = int(self._key_numbers[np.searchsorted(self._key_numbers, i, "right") - 1])
        starts = [key, 0]
        if self._film is not None and key <= self._next <= i:
            starts.insert(0, self._next)
        try:
            for start in starts:
                if start != self._next or self._film is None:
                    self._start(start)
                for frame in self._decoded:
                    number = self._next
                    if self._stamps is not None:
                        number = int(np.searchsorted(self._stamps[:-1], frame.pts))
                        if self._stamps[number] != frame.pts:
                            continue
                    self._next = number + 1
                    if number == i:
                        return frame
                    if number > i:
                        break
        except Exception:
            self._film = None
            raise
        self._film = None
        raise ValueError("the film ends before it, or it cannot be decoded")

    def _start(self, key: int) -> None:
        """Set the decoder to a key frame."""
        if self._film is not None:
            self._film.close()
        self._film = _av().open(f"file:{self._path}", metadata_errors="replace", options=CONTAINERS)
        stream = self._film.streams.video[0]
        if key:
            next(self._film.decode(stream))  # has the palette of all frames, if there is one
            self._film.seek(self._keys[key], stream=stream)
        self._decoded, self._next = self._film.decode(stream), key


def _packets(film: Any, stream: Any, is_reordered: bool) -> list[Packet]:
    """The packets of the film by its index, where that has all of them, else read one after the other."""
    if not is_reordered:
        entries = [e for e in getattr(stream, "index_entries", ()) if e.size and not e.is_discard]  # PyAV 17
        index = [(e.timestamp, e.timestamp, e.is_keyframe) for e in entries]
        if 0 < stream.frames == len(index):
            return index
    return [(p.pts, p.dts, p.is_keyframe) for p in film.demux(stream) if p.size and not p.is_discard]


def _brightness(frame: Any, name: str) -> np.ndarray:
    """The brightness of a decoded frame, or its colours as R, G, B."""
    pixels = frame.format
    bits = pixels.components[0].bits
    if not 8 <= bits <= 16:
        raise InputError(
            f"expected grey values of 8 to 16 bit, got {bits} bit ({pixels.name}; 16-bit grey AVI needs the code Y16); "
            "export it as TIFF",
            field=name,
        )
    if pixels.is_rgb or pixels.has_palette:
        return frame.reformat(format="rgb24" if bits == 8 else "rgb48le").to_ndarray()
    if any(component.plane == 0 for component in pixels.components[1:]):  # brightness between colours
        frame = frame.reformat(format="yuv444p" if bits == 8 else "yuv444p16le")
    kind = np.dtype("u1" if bits == 8 else ">u2" if pixels.is_big_endian else "<u2")
    plane = frame.planes[0]
    if plane.line_size < 0:  # stored from the bottom, which this method of PyAV alone regards
        return frame.to_ndarray()[: plane.height, : plane.width]
    return np.frombuffer(plane, kind).reshape(plane.height, -1)[:, : plane.width]


def _av() -> Any:
    av = optional("av", "video", "films (.avi, .mp4, .mov, .mkv)", ", or export the frames as TIFF")
    av.logging.set_level(av.logging.FATAL)  # FFmpeg writes errors to the console, which the exceptions repeat
    return av
