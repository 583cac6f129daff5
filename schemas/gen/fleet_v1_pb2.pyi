import datetime

from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Range(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "range_m", "no_echo")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    RANGE_M_FIELD_NUMBER: _ClassVar[int]
    NO_ECHO_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    range_m: float
    no_echo: bool
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., range_m: _Optional[float] = ..., no_echo: _Optional[bool] = ...) -> None: ...

class Battery(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "voltage_v", "charge", "charge_error", "level")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    VOLTAGE_V_FIELD_NUMBER: _ClassVar[int]
    CHARGE_FIELD_NUMBER: _ClassVar[int]
    CHARGE_ERROR_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    voltage_v: float
    charge: float
    charge_error: float
    level: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., voltage_v: _Optional[float] = ..., charge: _Optional[float] = ..., charge_error: _Optional[float] = ..., level: _Optional[str] = ...) -> None: ...

class Grayscale(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "raw")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    RAW_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    raw: int
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., raw: _Optional[int] = ...) -> None: ...

class Line(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "left_outer", "left_inner", "right_inner", "right_outer")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LEFT_OUTER_FIELD_NUMBER: _ClassVar[int]
    LEFT_INNER_FIELD_NUMBER: _ClassVar[int]
    RIGHT_INNER_FIELD_NUMBER: _ClassVar[int]
    RIGHT_OUTER_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    left_outer: bool
    left_inner: bool
    right_inner: bool
    right_outer: bool
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., left_outer: _Optional[bool] = ..., left_inner: _Optional[bool] = ..., right_inner: _Optional[bool] = ..., right_outer: _Optional[bool] = ...) -> None: ...

class Obstacle(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "left", "right")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    left: bool
    right: bool
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., left: _Optional[bool] = ..., right: _Optional[bool] = ...) -> None: ...

class Light(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "left", "right")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    left: bool
    right: bool
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., left: _Optional[bool] = ..., right: _Optional[bool] = ...) -> None: ...

class Imu(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "gyro_x_raw", "gyro_y_raw", "gyro_z_raw", "accel_x_raw", "accel_y_raw", "accel_z_raw")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    GYRO_X_RAW_FIELD_NUMBER: _ClassVar[int]
    GYRO_Y_RAW_FIELD_NUMBER: _ClassVar[int]
    GYRO_Z_RAW_FIELD_NUMBER: _ClassVar[int]
    ACCEL_X_RAW_FIELD_NUMBER: _ClassVar[int]
    ACCEL_Y_RAW_FIELD_NUMBER: _ClassVar[int]
    ACCEL_Z_RAW_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    gyro_x_raw: float
    gyro_y_raw: float
    gyro_z_raw: float
    accel_x_raw: float
    accel_y_raw: float
    accel_z_raw: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., gyro_x_raw: _Optional[float] = ..., gyro_y_raw: _Optional[float] = ..., gyro_z_raw: _Optional[float] = ..., accel_x_raw: _Optional[float] = ..., accel_y_raw: _Optional[float] = ..., accel_z_raw: _Optional[float] = ...) -> None: ...

class Arm(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "joint_deg")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    JOINT_DEG_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    joint_deg: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., joint_deg: _Optional[_Iterable[float]] = ...) -> None: ...

class Wheels(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "left_m_s", "right_m_s")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LEFT_M_S_FIELD_NUMBER: _ClassVar[int]
    RIGHT_M_S_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    left_m_s: float
    right_m_s: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., left_m_s: _Optional[float] = ..., right_m_s: _Optional[float] = ...) -> None: ...

class Odometer(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "left_m", "right_m")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LEFT_M_FIELD_NUMBER: _ClassVar[int]
    RIGHT_M_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    left_m: float
    right_m: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., left_m: _Optional[float] = ..., right_m: _Optional[float] = ...) -> None: ...

class Attitude(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "roll_rad", "pitch_rad", "yaw_rad")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ROLL_RAD_FIELD_NUMBER: _ClassVar[int]
    PITCH_RAD_FIELD_NUMBER: _ClassVar[int]
    YAW_RAD_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., roll_rad: _Optional[float] = ..., pitch_rad: _Optional[float] = ..., yaw_rad: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "frame", "x_m", "y_m", "heading_rad", "xy_std_m", "heading_std_rad")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    HEADING_RAD_FIELD_NUMBER: _ClassVar[int]
    XY_STD_M_FIELD_NUMBER: _ClassVar[int]
    HEADING_STD_RAD_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    frame: str
    x_m: float
    y_m: float
    heading_rad: float
    xy_std_m: float
    heading_std_rad: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., frame: _Optional[str] = ..., x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., heading_rad: _Optional[float] = ..., xy_std_m: _Optional[float] = ..., heading_std_rad: _Optional[float] = ...) -> None: ...

class Link(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "state", "reason", "url", "rx_bytes", "tx_bytes", "rx_frames", "tx_frames", "rejects", "reconnects", "tx_airtime", "since_s", "last_rx_s")
    class RejectsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    URL_FIELD_NUMBER: _ClassVar[int]
    RX_BYTES_FIELD_NUMBER: _ClassVar[int]
    TX_BYTES_FIELD_NUMBER: _ClassVar[int]
    RX_FRAMES_FIELD_NUMBER: _ClassVar[int]
    TX_FRAMES_FIELD_NUMBER: _ClassVar[int]
    REJECTS_FIELD_NUMBER: _ClassVar[int]
    RECONNECTS_FIELD_NUMBER: _ClassVar[int]
    TX_AIRTIME_FIELD_NUMBER: _ClassVar[int]
    SINCE_S_FIELD_NUMBER: _ClassVar[int]
    LAST_RX_S_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    state: str
    reason: str
    url: str
    rx_bytes: int
    tx_bytes: int
    rx_frames: int
    tx_frames: int
    rejects: _containers.ScalarMap[str, int]
    reconnects: int
    tx_airtime: float
    since_s: float
    last_rx_s: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., state: _Optional[str] = ..., reason: _Optional[str] = ..., url: _Optional[str] = ..., rx_bytes: _Optional[int] = ..., tx_bytes: _Optional[int] = ..., rx_frames: _Optional[int] = ..., tx_frames: _Optional[int] = ..., rejects: _Optional[_Mapping[str, int]] = ..., reconnects: _Optional[int] = ..., tx_airtime: _Optional[float] = ..., since_s: _Optional[float] = ..., last_rx_s: _Optional[float] = ...) -> None: ...

class Mode(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "asked", "inferred", "verdict", "evidence", "evidence_age_s", "candidates", "since_s")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    INFERRED_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    EVIDENCE_AGE_S_FIELD_NUMBER: _ClassVar[int]
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    SINCE_S_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    asked: str
    inferred: str
    verdict: str
    evidence: str
    evidence_age_s: float
    candidates: _containers.RepeatedScalarFieldContainer[str]
    since_s: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., asked: _Optional[str] = ..., inferred: _Optional[str] = ..., verdict: _Optional[str] = ..., evidence: _Optional[str] = ..., evidence_age_s: _Optional[float] = ..., candidates: _Optional[_Iterable[str]] = ..., since_s: _Optional[float] = ...) -> None: ...

class Motion(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "motion", "source", "speed", "owner", "expires_in_s", "fan", "servo_deg")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_IN_S_FIELD_NUMBER: _ClassVar[int]
    FAN_FIELD_NUMBER: _ClassVar[int]
    SERVO_DEG_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    motion: str
    source: str
    speed: float
    owner: str
    expires_in_s: float
    fan: bool
    servo_deg: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., motion: _Optional[str] = ..., source: _Optional[str] = ..., speed: _Optional[float] = ..., owner: _Optional[str] = ..., expires_in_s: _Optional[float] = ..., fan: _Optional[bool] = ..., servo_deg: _Optional[float] = ...) -> None: ...

class Estop(_message.Message):
    __slots__ = ("id", "by", "why", "stamp", "scope", "rank")
    ID_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    STAMP_FIELD_NUMBER: _ClassVar[int]
    SCOPE_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    id: str
    by: str
    why: str
    stamp: _timestamp_pb2.Timestamp
    scope: str
    rank: str
    def __init__(self, id: _Optional[str] = ..., by: _Optional[str] = ..., why: _Optional[str] = ..., stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., scope: _Optional[str] = ..., rank: _Optional[str] = ...) -> None: ...

class Hold(_message.Message):
    __slots__ = ("by", "since", "rank")
    BY_FIELD_NUMBER: _ClassVar[int]
    SINCE_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    by: str
    since: _timestamp_pb2.Timestamp
    rank: str
    def __init__(self, by: _Optional[str] = ..., since: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., rank: _Optional[str] = ...) -> None: ...

class Pause(_message.Message):
    __slots__ = ("id", "by", "why", "stamp", "rank")
    ID_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    STAMP_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    id: str
    by: str
    why: str
    stamp: _timestamp_pb2.Timestamp
    rank: str
    def __init__(self, id: _Optional[str] = ..., by: _Optional[str] = ..., why: _Optional[str] = ..., stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., rank: _Optional[str] = ...) -> None: ...

class Loan(_message.Message):
    __slots__ = ("to", "by", "rank", "since", "expires_in_s")
    TO_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    SINCE_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_IN_S_FIELD_NUMBER: _ClassVar[int]
    to: str
    by: str
    rank: str
    since: _timestamp_pb2.Timestamp
    expires_in_s: float
    def __init__(self, to: _Optional[str] = ..., by: _Optional[str] = ..., rank: _Optional[str] = ..., since: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., expires_in_s: _Optional[float] = ...) -> None: ...

class CarPeople(_message.Message):
    __slots__ = ("leads", "drivers", "others")
    LEADS_FIELD_NUMBER: _ClassVar[int]
    DRIVERS_FIELD_NUMBER: _ClassVar[int]
    OTHERS_FIELD_NUMBER: _ClassVar[int]
    leads: _containers.RepeatedScalarFieldContainer[str]
    drivers: _containers.RepeatedScalarFieldContainer[str]
    others: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, leads: _Optional[_Iterable[str]] = ..., drivers: _Optional[_Iterable[str]] = ..., others: _Optional[_Iterable[str]] = ...) -> None: ...

class Lease(_message.Message):
    __slots__ = ("holder", "kind", "expires_in_s")
    HOLDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_IN_S_FIELD_NUMBER: _ClassVar[int]
    holder: str
    kind: str
    expires_in_s: float
    def __init__(self, holder: _Optional[str] = ..., kind: _Optional[str] = ..., expires_in_s: _Optional[float] = ...) -> None: ...

class Safety(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "estops", "ended", "hold", "lease", "motors", "worst_stop_s", "motors_basis", "trust", "trust_evidence", "shown_age_s", "pauses", "ended_pauses", "loan", "people", "waits_for", "trust_since_s")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ESTOPS_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    HOLD_FIELD_NUMBER: _ClassVar[int]
    LEASE_FIELD_NUMBER: _ClassVar[int]
    MOTORS_FIELD_NUMBER: _ClassVar[int]
    WORST_STOP_S_FIELD_NUMBER: _ClassVar[int]
    MOTORS_BASIS_FIELD_NUMBER: _ClassVar[int]
    TRUST_FIELD_NUMBER: _ClassVar[int]
    TRUST_EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    SHOWN_AGE_S_FIELD_NUMBER: _ClassVar[int]
    PAUSES_FIELD_NUMBER: _ClassVar[int]
    ENDED_PAUSES_FIELD_NUMBER: _ClassVar[int]
    LOAN_FIELD_NUMBER: _ClassVar[int]
    PEOPLE_FIELD_NUMBER: _ClassVar[int]
    WAITS_FOR_FIELD_NUMBER: _ClassVar[int]
    TRUST_SINCE_S_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    estops: _containers.RepeatedCompositeFieldContainer[Estop]
    ended: _containers.RepeatedScalarFieldContainer[str]
    hold: Hold
    lease: Lease
    motors: str
    worst_stop_s: float
    motors_basis: str
    trust: str
    trust_evidence: str
    shown_age_s: float
    pauses: _containers.RepeatedCompositeFieldContainer[Pause]
    ended_pauses: _containers.RepeatedScalarFieldContainer[str]
    loan: Loan
    people: CarPeople
    waits_for: str
    trust_since_s: float
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., estops: _Optional[_Iterable[_Union[Estop, _Mapping]]] = ..., ended: _Optional[_Iterable[str]] = ..., hold: _Optional[_Union[Hold, _Mapping]] = ..., lease: _Optional[_Union[Lease, _Mapping]] = ..., motors: _Optional[str] = ..., worst_stop_s: _Optional[float] = ..., motors_basis: _Optional[str] = ..., trust: _Optional[str] = ..., trust_evidence: _Optional[str] = ..., shown_age_s: _Optional[float] = ..., pauses: _Optional[_Iterable[_Union[Pause, _Mapping]]] = ..., ended_pauses: _Optional[_Iterable[str]] = ..., loan: _Optional[_Union[Loan, _Mapping]] = ..., people: _Optional[_Union[CarPeople, _Mapping]] = ..., waits_for: _Optional[str] = ..., trust_since_s: _Optional[float] = ...) -> None: ...

class Health(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "host", "link", "pid", "version", "platform", "platform_evidence", "capabilities", "uptime_s", "loop_lag_s", "cpu", "rss_mb", "bus_drops", "platform_contradictions", "shows_stops", "shows_stops_words", "doubted", "interval_s", "interval_spread_s", "interval_no_echo_s", "blocks_s", "reporting_modes", "out_of_range")
    class BlocksSEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    LINK_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    PLATFORM_FIELD_NUMBER: _ClassVar[int]
    PLATFORM_EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    CAPABILITIES_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    LOOP_LAG_S_FIELD_NUMBER: _ClassVar[int]
    CPU_FIELD_NUMBER: _ClassVar[int]
    RSS_MB_FIELD_NUMBER: _ClassVar[int]
    BUS_DROPS_FIELD_NUMBER: _ClassVar[int]
    PLATFORM_CONTRADICTIONS_FIELD_NUMBER: _ClassVar[int]
    SHOWS_STOPS_FIELD_NUMBER: _ClassVar[int]
    SHOWS_STOPS_WORDS_FIELD_NUMBER: _ClassVar[int]
    DOUBTED_FIELD_NUMBER: _ClassVar[int]
    INTERVAL_S_FIELD_NUMBER: _ClassVar[int]
    INTERVAL_SPREAD_S_FIELD_NUMBER: _ClassVar[int]
    INTERVAL_NO_ECHO_S_FIELD_NUMBER: _ClassVar[int]
    BLOCKS_S_FIELD_NUMBER: _ClassVar[int]
    REPORTING_MODES_FIELD_NUMBER: _ClassVar[int]
    OUT_OF_RANGE_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    host: str
    link: str
    pid: int
    version: str
    platform: str
    platform_evidence: _containers.RepeatedScalarFieldContainer[str]
    capabilities: _containers.RepeatedScalarFieldContainer[str]
    uptime_s: float
    loop_lag_s: float
    cpu: float
    rss_mb: float
    bus_drops: int
    platform_contradictions: _containers.RepeatedScalarFieldContainer[str]
    shows_stops: str
    shows_stops_words: str
    doubted: bool
    interval_s: float
    interval_spread_s: float
    interval_no_echo_s: float
    blocks_s: _containers.ScalarMap[str, float]
    reporting_modes: _containers.RepeatedScalarFieldContainer[str]
    out_of_range: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., host: _Optional[str] = ..., link: _Optional[str] = ..., pid: _Optional[int] = ..., version: _Optional[str] = ..., platform: _Optional[str] = ..., platform_evidence: _Optional[_Iterable[str]] = ..., capabilities: _Optional[_Iterable[str]] = ..., uptime_s: _Optional[float] = ..., loop_lag_s: _Optional[float] = ..., cpu: _Optional[float] = ..., rss_mb: _Optional[float] = ..., bus_drops: _Optional[int] = ..., platform_contradictions: _Optional[_Iterable[str]] = ..., shows_stops: _Optional[str] = ..., shows_stops_words: _Optional[str] = ..., doubted: _Optional[bool] = ..., interval_s: _Optional[float] = ..., interval_spread_s: _Optional[float] = ..., interval_no_echo_s: _Optional[float] = ..., blocks_s: _Optional[_Mapping[str, float]] = ..., reporting_modes: _Optional[_Iterable[str]] = ..., out_of_range: _Optional[_Iterable[str]] = ...) -> None: ...

class RxFrame(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "data", "verdict", "published")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    data: bytes
    verdict: str
    published: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., data: _Optional[bytes] = ..., verdict: _Optional[str] = ..., published: _Optional[_Iterable[str]] = ...) -> None: ...

class TxFrame(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "data", "command_id", "why", "written")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    COMMAND_ID_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    WRITTEN_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    data: bytes
    command_id: str
    why: str
    written: bool
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., data: _Optional[bytes] = ..., command_id: _Optional[str] = ..., why: _Optional[str] = ..., written: _Optional[bool] = ...) -> None: ...

class CommandEvent(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "id", "verb", "sender", "kind", "phase", "reason", "words", "request", "request_encoding", "age_s", "worst_case_s", "took_s", "evidence", "count", "basis")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    VERB_FIELD_NUMBER: _ClassVar[int]
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    WORDS_FIELD_NUMBER: _ClassVar[int]
    REQUEST_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ENCODING_FIELD_NUMBER: _ClassVar[int]
    AGE_S_FIELD_NUMBER: _ClassVar[int]
    WORST_CASE_S_FIELD_NUMBER: _ClassVar[int]
    TOOK_S_FIELD_NUMBER: _ClassVar[int]
    EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    BASIS_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    id: str
    verb: str
    sender: str
    kind: str
    phase: str
    reason: str
    words: str
    request: bytes
    request_encoding: str
    age_s: float
    worst_case_s: float
    took_s: float
    evidence: _containers.RepeatedScalarFieldContainer[str]
    count: int
    basis: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., id: _Optional[str] = ..., verb: _Optional[str] = ..., sender: _Optional[str] = ..., kind: _Optional[str] = ..., phase: _Optional[str] = ..., reason: _Optional[str] = ..., words: _Optional[str] = ..., request: _Optional[bytes] = ..., request_encoding: _Optional[str] = ..., age_s: _Optional[float] = ..., worst_case_s: _Optional[float] = ..., took_s: _Optional[float] = ..., evidence: _Optional[_Iterable[str]] = ..., count: _Optional[int] = ..., basis: _Optional[str] = ...) -> None: ...

class Truth(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "x_m", "y_m", "heading_rad", "mode", "motor_left", "motor_right", "blocked", "fan", "led")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    HEADING_RAD_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    MOTOR_LEFT_FIELD_NUMBER: _ClassVar[int]
    MOTOR_RIGHT_FIELD_NUMBER: _ClassVar[int]
    BLOCKED_FIELD_NUMBER: _ClassVar[int]
    FAN_FIELD_NUMBER: _ClassVar[int]
    LED_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    x_m: float
    y_m: float
    heading_rad: float
    mode: str
    motor_left: int
    motor_right: int
    blocked: bool
    fan: bool
    led: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., heading_rad: _Optional[float] = ..., mode: _Optional[str] = ..., motor_left: _Optional[int] = ..., motor_right: _Optional[int] = ..., blocked: _Optional[bool] = ..., fan: _Optional[bool] = ..., led: _Optional[str] = ...) -> None: ...

class SimLamp(_message.Message):
    __slots__ = ("name", "x_m", "y_m", "on", "brightness", "reach_m", "carried_by")
    NAME_FIELD_NUMBER: _ClassVar[int]
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    ON_FIELD_NUMBER: _ClassVar[int]
    BRIGHTNESS_FIELD_NUMBER: _ClassVar[int]
    REACH_M_FIELD_NUMBER: _ClassVar[int]
    CARRIED_BY_FIELD_NUMBER: _ClassVar[int]
    name: str
    x_m: float
    y_m: float
    on: bool
    brightness: float
    reach_m: float
    carried_by: str
    def __init__(self, name: _Optional[str] = ..., x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., on: _Optional[bool] = ..., brightness: _Optional[float] = ..., reach_m: _Optional[float] = ..., carried_by: _Optional[str] = ...) -> None: ...

class SimThing(_message.Message):
    __slots__ = ("name", "x_m", "y_m", "heading_rad", "radius_m", "width_m", "depth_m", "speed_m_s", "carried_by")
    NAME_FIELD_NUMBER: _ClassVar[int]
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    HEADING_RAD_FIELD_NUMBER: _ClassVar[int]
    RADIUS_M_FIELD_NUMBER: _ClassVar[int]
    WIDTH_M_FIELD_NUMBER: _ClassVar[int]
    DEPTH_M_FIELD_NUMBER: _ClassVar[int]
    SPEED_M_S_FIELD_NUMBER: _ClassVar[int]
    CARRIED_BY_FIELD_NUMBER: _ClassVar[int]
    name: str
    x_m: float
    y_m: float
    heading_rad: float
    radius_m: float
    width_m: float
    depth_m: float
    speed_m_s: float
    carried_by: str
    def __init__(self, name: _Optional[str] = ..., x_m: _Optional[float] = ..., y_m: _Optional[float] = ..., heading_rad: _Optional[float] = ..., radius_m: _Optional[float] = ..., width_m: _Optional[float] = ..., depth_m: _Optional[float] = ..., speed_m_s: _Optional[float] = ..., carried_by: _Optional[str] = ...) -> None: ...

class SimPoint(_message.Message):
    __slots__ = ("x_m", "y_m")
    X_M_FIELD_NUMBER: _ClassVar[int]
    Y_M_FIELD_NUMBER: _ClassVar[int]
    x_m: float
    y_m: float
    def __init__(self, x_m: _Optional[float] = ..., y_m: _Optional[float] = ...) -> None: ...

class SimWall(_message.Message):
    __slots__ = ("begin", "end")
    BEGIN_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    begin: SimPoint
    end: SimPoint
    def __init__(self, begin: _Optional[_Union[SimPoint, _Mapping]] = ..., end: _Optional[_Union[SimPoint, _Mapping]] = ...) -> None: ...

class World(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "lamps", "things", "walls", "line")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LAMPS_FIELD_NUMBER: _ClassVar[int]
    THINGS_FIELD_NUMBER: _ClassVar[int]
    WALLS_FIELD_NUMBER: _ClassVar[int]
    LINE_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    lamps: _containers.RepeatedCompositeFieldContainer[SimLamp]
    things: _containers.RepeatedCompositeFieldContainer[SimThing]
    walls: _containers.RepeatedCompositeFieldContainer[SimWall]
    line: _containers.RepeatedCompositeFieldContainer[SimPoint]
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., lamps: _Optional[_Iterable[_Union[SimLamp, _Mapping]]] = ..., things: _Optional[_Iterable[_Union[SimThing, _Mapping]]] = ..., walls: _Optional[_Iterable[_Union[SimWall, _Mapping]]] = ..., line: _Optional[_Iterable[_Union[SimPoint, _Mapping]]] = ...) -> None: ...

class Plan(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "text", "version", "set_by")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    SET_BY_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    text: str
    version: str
    set_by: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., text: _Optional[str] = ..., version: _Optional[str] = ..., set_by: _Optional[str] = ...) -> None: ...

class Role(_message.Message):
    __slots__ = ("name", "cars")
    NAME_FIELD_NUMBER: _ClassVar[int]
    CARS_FIELD_NUMBER: _ClassVar[int]
    name: str
    cars: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, name: _Optional[str] = ..., cars: _Optional[_Iterable[str]] = ...) -> None: ...

class Assignment(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "roles", "phase", "plan_version", "rules", "stopped_by")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ROLES_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    PLAN_VERSION_FIELD_NUMBER: _ClassVar[int]
    RULES_FIELD_NUMBER: _ClassVar[int]
    STOPPED_BY_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    roles: _containers.RepeatedCompositeFieldContainer[Role]
    phase: str
    plan_version: str
    rules: _containers.RepeatedScalarFieldContainer[str]
    stopped_by: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., roles: _Optional[_Iterable[_Union[Role, _Mapping]]] = ..., phase: _Optional[str] = ..., plan_version: _Optional[str] = ..., rules: _Optional[_Iterable[str]] = ..., stopped_by: _Optional[str] = ...) -> None: ...

class Decision(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "subject", "decided", "why", "readings", "would_change", "kind", "role", "since")
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SUBJECT_FIELD_NUMBER: _ClassVar[int]
    DECIDED_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    READINGS_FIELD_NUMBER: _ClassVar[int]
    WOULD_CHANGE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ROLE_FIELD_NUMBER: _ClassVar[int]
    SINCE_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    subject: str
    decided: str
    why: str
    readings: _containers.RepeatedScalarFieldContainer[str]
    would_change: str
    kind: str
    role: str
    since: _timestamp_pb2.Timestamp
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., subject: _Optional[str] = ..., decided: _Optional[str] = ..., why: _Optional[str] = ..., readings: _Optional[_Iterable[str]] = ..., would_change: _Optional[str] = ..., kind: _Optional[str] = ..., role: _Optional[str] = ..., since: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class Recording(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "session", "state", "bytes", "messages", "drops", "free_bytes", "error", "missed", "recovered", "segments", "warning")
    class DropsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class MissedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class RecoveredEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    MESSAGES_FIELD_NUMBER: _ClassVar[int]
    DROPS_FIELD_NUMBER: _ClassVar[int]
    FREE_BYTES_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    MISSED_FIELD_NUMBER: _ClassVar[int]
    RECOVERED_FIELD_NUMBER: _ClassVar[int]
    SEGMENTS_FIELD_NUMBER: _ClassVar[int]
    WARNING_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    session: str
    state: str
    bytes: int
    messages: int
    drops: _containers.ScalarMap[str, int]
    free_bytes: int
    error: str
    missed: _containers.ScalarMap[str, int]
    recovered: _containers.ScalarMap[str, int]
    segments: int
    warning: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., session: _Optional[str] = ..., state: _Optional[str] = ..., bytes: _Optional[int] = ..., messages: _Optional[int] = ..., drops: _Optional[_Mapping[str, int]] = ..., free_bytes: _Optional[int] = ..., error: _Optional[str] = ..., missed: _Optional[_Mapping[str, int]] = ..., recovered: _Optional[_Mapping[str, int]] = ..., segments: _Optional[int] = ..., warning: _Optional[str] = ...) -> None: ...

class Supervised(_message.Message):
    __slots__ = ("name", "kind", "state", "pid", "restarts", "since_s", "words")
    NAME_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    RESTARTS_FIELD_NUMBER: _ClassVar[int]
    SINCE_S_FIELD_NUMBER: _ClassVar[int]
    WORDS_FIELD_NUMBER: _ClassVar[int]
    name: str
    kind: str
    state: str
    pid: int
    restarts: int
    since_s: float
    words: str
    def __init__(self, name: _Optional[str] = ..., kind: _Optional[str] = ..., state: _Optional[str] = ..., pid: _Optional[int] = ..., restarts: _Optional[int] = ..., since_s: _Optional[float] = ..., words: _Optional[str] = ...) -> None: ...

class Supervision(_message.Message):
    __slots__ = ("stamp", "car", "seq", "boot_id", "state", "host", "pid", "uptime_s", "fleet_file", "directory", "processes", "became", "missing", "session", "groups", "colors", "unrecorded")
    class BecameEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    class MissingEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    class GroupsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    class ColorsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    STAMP_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    FLEET_FILE_FIELD_NUMBER: _ClassVar[int]
    DIRECTORY_FIELD_NUMBER: _ClassVar[int]
    PROCESSES_FIELD_NUMBER: _ClassVar[int]
    BECAME_FIELD_NUMBER: _ClassVar[int]
    MISSING_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    GROUPS_FIELD_NUMBER: _ClassVar[int]
    COLORS_FIELD_NUMBER: _ClassVar[int]
    UNRECORDED_FIELD_NUMBER: _ClassVar[int]
    stamp: _timestamp_pb2.Timestamp
    car: str
    seq: int
    boot_id: str
    state: str
    host: str
    pid: int
    uptime_s: float
    fleet_file: str
    directory: str
    processes: _containers.RepeatedCompositeFieldContainer[Supervised]
    became: _containers.ScalarMap[str, str]
    missing: _containers.ScalarMap[str, str]
    session: str
    groups: _containers.ScalarMap[str, str]
    colors: _containers.ScalarMap[str, str]
    unrecorded: str
    def __init__(self, stamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., car: _Optional[str] = ..., seq: _Optional[int] = ..., boot_id: _Optional[str] = ..., state: _Optional[str] = ..., host: _Optional[str] = ..., pid: _Optional[int] = ..., uptime_s: _Optional[float] = ..., fleet_file: _Optional[str] = ..., directory: _Optional[str] = ..., processes: _Optional[_Iterable[_Union[Supervised, _Mapping]]] = ..., became: _Optional[_Mapping[str, str]] = ..., missing: _Optional[_Mapping[str, str]] = ..., session: _Optional[str] = ..., groups: _Optional[_Mapping[str, str]] = ..., colors: _Optional[_Mapping[str, str]] = ..., unrecorded: _Optional[str] = ...) -> None: ...

class DownCommand(_message.Message):
    __slots__ = ("sender", "kind", "id")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ...) -> None: ...

class ReloadCommand(_message.Message):
    __slots__ = ("sender", "kind", "id")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ...) -> None: ...

class PlanCommand(_message.Message):
    __slots__ = ("sender", "kind", "id")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ...) -> None: ...

class DriveCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "motion", "duration_s", "continues")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    CONTINUES_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    motion: str
    duration_s: float
    continues: bool
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., motion: _Optional[str] = ..., duration_s: _Optional[float] = ..., continues: _Optional[bool] = ...) -> None: ...

class ModeCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "mode")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    mode: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., mode: _Optional[str] = ...) -> None: ...

class LedCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "r", "g", "b")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    R_FIELD_NUMBER: _ClassVar[int]
    G_FIELD_NUMBER: _ClassVar[int]
    B_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    r: int
    g: int
    b: int
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., r: _Optional[int] = ..., g: _Optional[int] = ..., b: _Optional[int] = ...) -> None: ...

class LightCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "light")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    LIGHT_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    light: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., light: _Optional[str] = ...) -> None: ...

class ServoCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "servo", "action", "deg")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    SERVO_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    DEG_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    servo: str
    action: str
    deg: int
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., servo: _Optional[str] = ..., action: _Optional[str] = ..., deg: _Optional[int] = ...) -> None: ...

class ArmCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "joint_deg")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    JOINT_DEG_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    joint_deg: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., joint_deg: _Optional[_Iterable[int]] = ...) -> None: ...

class WhistleCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ...) -> None: ...

class SpeedCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "step")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    step: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., step: _Optional[str] = ...) -> None: ...

class FanCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "state")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    state: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., state: _Optional[str] = ...) -> None: ...

class StopCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ...) -> None: ...

class EstopCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "why", "scope")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    SCOPE_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    why: str
    scope: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., why: _Optional[str] = ..., scope: _Optional[str] = ...) -> None: ...

class ResumeCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "ids", "all")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    IDS_FIELD_NUMBER: _ClassVar[int]
    ALL_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    ids: _containers.RepeatedScalarFieldContainer[str]
    all: bool
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., ids: _Optional[_Iterable[str]] = ..., all: _Optional[bool] = ...) -> None: ...

class LeaseCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "release")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    RELEASE_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    release: bool
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., release: _Optional[bool] = ...) -> None: ...

class FindCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ...) -> None: ...

class PauseCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "why")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    WHY_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    why: str
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., why: _Optional[str] = ...) -> None: ...

class UnpauseCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "ids")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    IDS_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    ids: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., ids: _Optional[_Iterable[str]] = ...) -> None: ...

class LendCommand(_message.Message):
    __slots__ = ("sender", "kind", "id", "asked", "take", "ttl_s", "to", "duration_s", "end")
    SENDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    ASKED_FIELD_NUMBER: _ClassVar[int]
    TAKE_FIELD_NUMBER: _ClassVar[int]
    TTL_S_FIELD_NUMBER: _ClassVar[int]
    TO_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    sender: str
    kind: str
    id: str
    asked: _timestamp_pb2.Timestamp
    take: bool
    ttl_s: float
    to: str
    duration_s: float
    end: bool
    def __init__(self, sender: _Optional[str] = ..., kind: _Optional[str] = ..., id: _Optional[str] = ..., asked: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., take: _Optional[bool] = ..., ttl_s: _Optional[float] = ..., to: _Optional[str] = ..., duration_s: _Optional[float] = ..., end: _Optional[bool] = ...) -> None: ...

class Result(_message.Message):
    __slots__ = ("id", "status", "reason", "words", "worst_case_s", "car")
    ID_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    WORDS_FIELD_NUMBER: _ClassVar[int]
    WORST_CASE_S_FIELD_NUMBER: _ClassVar[int]
    CAR_FIELD_NUMBER: _ClassVar[int]
    id: str
    status: str
    reason: str
    words: str
    worst_case_s: float
    car: str
    def __init__(self, id: _Optional[str] = ..., status: _Optional[str] = ..., reason: _Optional[str] = ..., words: _Optional[str] = ..., worst_case_s: _Optional[float] = ..., car: _Optional[str] = ...) -> None: ...
