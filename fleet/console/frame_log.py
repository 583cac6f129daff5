"""The raw frames of one car, each with the readings or the command that belongs to it, and what its gateway knows.

Pure.
"""

from collections import deque
from typing import Any, Final

from fleet.client.diagnosis import describe_reports
from schemas import messages
from schemas.printable import printable_lines

MAX_FRAMES: Final = 60
"""Number of frames that a page shows."""
MAX_FRAME_BYTES: Final = 80
"""Number of bytes of a frame that a page shows."""
_COUNTS: Final = ("url", "rx_frames", "tx_frames", "rx_bytes", "tx_bytes", "reconnects")
_HEALTH: Final = ("host", "pid", "version", "platform")


class FrameLog:
    """The newest frames of one car, the newest last."""

    def __init__(self) -> None:
        self._frames: deque[dict[str, Any]] = deque(maxlen=MAX_FRAMES)

    def on_frame(self, topic: str, frame: Any) -> None:
        """Handle a frame. topic: `frame/rx` or `frame/tx`."""
        data = frame.data[:MAX_FRAME_BYTES].decode("ascii", "backslashreplace")
        text = printable_lines(data.replace("\r", "\\r").replace("\n", "\\n"))
        at_ms = messages.stamp_ms(frame.stamp)
        if topic == "frame/rx":
            became = ", ".join(key.partition("/")[2] for key in frame.published)
            shown = {"from_car": True, "verdict": frame.verdict, "became": became}
        else:
            verdict = frame.why if frame.written else f"{frame.why}, NOT written"
            shown = {"from_car": False, "verdict": verdict, "became": frame.command_id[:8]}
        self._frames.append({"at_ms": at_ms, "text": text, **shown})

    def as_list(self) -> list[dict[str, Any]]:
        """Return the frames, the newest first."""
        return list(reversed(self._frames))


def describe_gateway(link: Any, health: Any, safety: Any, mode: Any) -> list[tuple[str, str]]:
    """Return what a gateway knows of its car and link, as names and texts.

    An argument of None means that there is no message.
    """
    rows: list[tuple[str, str]] = []
    if link is not None:
        rows += [(name, str(getattr(link, name))) for name in _COUNTS]
        rows.append(("rejected frames", ", ".join(f"{name} {count}" for name, count in sorted(link.rejects.items()))))
        rows.append(("airtime of our frames", f"{link.tx_airtime:.0%}"))
    if health is not None:
        rows += [(name, str(getattr(health, name))) for name in _HEALTH]
        rows.append(("platform evidence", "; ".join(health.platform_evidence)))
        rows.append(("platform contradictions", "; ".join(health.platform_contradictions)))
        rows.append(("its reports", describe_reports(health)))
        rows.append(("loop lag", f"{health.loop_lag_s * 1e3:.0f} ms"))
    if safety is not None:
        rows += [("trust", safety.trust), ("trust evidence", safety.trust_evidence)]
        longest = f"{safety.worst_stop_s:.2f} s" if safety.HasField("worst_stop_s") else "unknown: the link is down"
        rows.append(("a stop now takes at most", longest))
    if mode is not None:
        rows += [("mode evidence", mode.evidence), ("possible modes", ", ".join(mode.candidates))]
    return [(name, text) for name, text in rows if text]
