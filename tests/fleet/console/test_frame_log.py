"""Raw frames as a page shows them."""

from fleet.console.frame_log import MAX_FRAME_BYTES, MAX_FRAMES, FrameLog, describe_gateway
from schemas.gen import fleet_v1_pb2 as pb


def test_frames_are_bounded_and_readable() -> None:
    log = FrameLog()
    for number in range(2 * MAX_FRAMES):
        log.on_frame("frame/rx", pb.RxFrame(data=b"$4WD\r\xff\x07" + b"x" * 500, verdict=str(number)))
    frames = log.as_list()
    assert len(frames) == MAX_FRAMES
    assert frames[0]["verdict"] == str(2 * MAX_FRAMES - 1)
    assert frames[0]["text"].startswith("$4WD\\r\\xff\\x07")
    assert len(frames[0]["text"]) < 2 * MAX_FRAME_BYTES


def test_frame_that_was_not_written_says_so() -> None:
    log = FrameLog()
    log.on_frame("frame/tx", pb.TxFrame(data=b"$0,0,0,0,0,0,0,0,0#", why="stop", command_id="0123456789ab"))
    (frame,) = log.as_list()
    assert (frame["verdict"], frame["became"], frame["from_car"]) == ("stop, NOT written", "01234567", False)


def test_gateway_that_said_nothing_has_no_rows() -> None:
    assert describe_gateway(None, None, None, None) == []
    rows = dict(describe_gateway(pb.Link(rx_frames=3, rejects={"junk": 2}), None, None, None))
    assert (rows["rx_frames"], rows["rejected frames"]) == ("3", "junk 2")
