"""The logs of autopilots, all little-endian.

PX4's ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html); the log of a Crazyflie on its micro SD card
(``src/deck/drivers/src/usddeck.c`` of the firmware); and ArduPilot's dataflash log, which describes itself: each
message FMT says how one kind of message is packed
(https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html, ``AP_Logger/LogStructure.h``).
"""

from __future__ import annotations

import itertools
import re
import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from torchrl_quad.airframe import quarters
from torchrl_quad.deploy.frames import motor_signal
from torchrl_quad.errors import shown
from torchrl_quad.identification.errors import NoFlight, UnreadableLog, WrongMotors
from torchrl_quad.identification.signals import MAX_COLUMNS, Array, Stream, numbers

_SYNC = bytes.fromhex("2f731320250cbb12")
_KINDS = frozenset(b"BFIMPQARDLCSO")
_TYPES = {f"{sign}int{8 * size}_t": f"<{sign[:1] or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
_TYPES |= {"float": "<f4", "double": "<f8", "bool": "<i1", "char": "<i1"}
_FIELD = re.compile(r"([\w/-]+)(?:\[(\d+)\])? (\w+)")
_TICKS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}
_VARIABLE = re.compile(r"(.+)\(([bBhHiIqQfd?])\)")


class _Subscription(NamedTuple):
    """A message that is logged, and where in the file its samples are."""

    name: str
    instance: int
    record: np.dtype
    starts: array


def read_ulog(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each message: columns ``message.field``, or ``message#1.field`` of its second instance.

    Where a message says when its data were sampled, that is its time. A motor that is stopped has the command 0.
    ``actuator_motors.signal`` is what leaves for the motors, in the order of the quad X: PX4 undoes the thrust curve of
    THR_MDL_FAC after it has logged ``actuator_motors.control`` (``FunctionMotors.hpp``). In older logs
    ``actuator_outputs.signal`` is: pulses of the instance that moves, from PWM_MIN to PWM_MAX. The file is read once,
    in time and memory proportional to its size; the notes say what could not be read.

    Raises:
        LogError: it was never armed, or is not of a drone with four rotors.
    """
    log = _Log(data)
    log.scan()
    used = sorted((s for s in log.subscriptions if s.starts), key=lambda s: s[:2])
    if not used:
        raise UnreadableLog(f"{name} is not a readable ULog: it holds no sample of any message. Copy it again.")
    notes = []
    if log.damage or log.unread:
        notes.append(f"the ULog is damaged: {log.damage} messages and {log.unread} bytes were not read")
    if log.dropouts:
        lost = sum(log.dropouts) / 1000.0
        notes.append(f"the logger lost {lost:.2f} s in {len(log.dropouts)} dropouts: gaps where samples are missing")
    streams = {}
    for message in used:
        parts = message.record.names or ()
        if "timestamp" not in parts or message.record["timestamp"].kind not in "iu":
            notes.append(f"{message.name} was left out: it has no timestamp")
            continue
        rows = pick(data, message.starts, message.record)
        stem = message.name + (f"#{message.instance}" if message.instance else "")
        columns = {f"{stem}.{part}": rows[part] for part in parts}
        sampled = columns.get(f"{stem}.timestamp_sample")
        time = columns[f"{stem}.timestamp"] if sampled is None or not sampled.all() else sampled
        streams[stem] = Stream(stem, time * 1e-6, columns)
    _check_vehicle(streams, log.parameters, name)
    notes.append(_add_signals(streams, log.parameters))
    return list(streams.values()), notes


# By MAV_TYPE of MAVLink, the vehicles that do not fly by four rotors alone.
_VEHICLES = dict.fromkeys(range(19, 26), "a VTOL") | {1: "an aeroplane", 4: "a helicopter", 13: "a hexacopter"}
_VEHICLES |= {14: "an octocopter", 15: "a tricopter", 29: "a dodecacopter", 35: "a decacopter"}
_CORNERS = (0, 2, 3, 1)  # of motors 1 to 4 of the quad X, by their quarters where y points right
_OUTPUTS = re.compile(r"actuator_outputs(#\d+)?")


def _check_vehicle(streams: Mapping[str, Stream], parameters: Mapping[str, float], name: str) -> None:
    column = {column: x for stream in streams.values() for column, x in stream.columns.items()}
    pulses = {c: x for c, x in column.items() if _OUTPUTS.match(c) and re.search(r"output\[\d+\]$", c) and x.any()}
    rest = parameters.get("PWM_DISARMED", 900)
    motors = sorted({int(c.split("[")[1][:-1]) for c, x in pulses.items() if x.min() <= rest < x.max()})
    for state, least in (("actuator_armed.armed", 1), ("vehicle_status.arming_state", 2)):
        if state in column and column[state].max() < least:
            stay = f": its motors stay at PWM_DISARMED = {rest:g} us" if pulses and not motors else ""
            raise NoFlight(f"{name} was never armed{stay}. Give the log of a flight.")
    kind = int(parameters.get("MAV_TYPE", 2))
    count = int(parameters.get("CA_ROTOR_COUNT", 0))
    control = (column.get(f"actuator_motors.control[{k}]", np.zeros(1)) for k in range(12))
    driven = sum(bool((np.nan_to_num(x.astype(float)) > 0.02).any()) for x in control)
    if kind in _VEHICLES:
        which = f"; its lift motors are outputs {motors[0]} to {motors[-1]}" if kind in range(19, 26) and motors else ""
        said = f"{_VEHICLES[kind]} (MAV_TYPE {kind}{which})"
    elif count not in (0, 4):
        said = f"a drone with {count} rotors (CA_ROTOR_COUNT)"
    elif driven > 4:
        said = f"a drone with {driven} motors (actuator_motors)"
    else:
        return
    raise WrongMotors(f"{name} is the log of {said}. Only drones that fly by four rotors are fitted.")


def _add_signals(streams: dict[str, Stream], parameters: Mapping[str, float]) -> str:
    """The signals of the motors as columns of a stream; and a note on them."""
    placed = quarters([[parameters.get(f"CA_ROTOR{k}_P{x}", 0.0) for x in "XY"] for k in range(4)])
    order = [placed.index(quarter) for quarter in _CORNERS] if placed else range(4)
    outputs = [stem for stem in streams if _OUTPUTS.fullmatch(stem)]
    stem, signals, said = "", {}, "nowhere: neither actuator_motors nor actuator_outputs were logged"
    if "actuator_motors" in streams:
        stem, curve = "actuator_motors", min(max(parameters.get("THR_MDL_FAC", 0.0), 0.0), 1.0)
        said = f"actuator_motors, after the thrust curve of THR_MDL_FAC = {curve:g}"
        for k, motor in enumerate(order):
            control = streams[stem].columns.get(f"{stem}.control[{motor}]")
            if control is not None:
                with np.errstate(over="ignore"):
                    signals[f"{stem}.signal[{k}]"] = motor_signal(np.nan_to_num(numbers(control)), curve)
    elif outputs:
        ports = {parameters.get(f"PWM_{p}_FUNC{n}"): (p, n) for p in ("AUX", "MAIN") for n in range(16, 0, -1)}
        of, places = {}, {}
        for x in outputs:  # without functions, motors are the four that begin at rest, as no gimbal does, or the first
            each = [streams[x].columns.get(f"{x}.output[{n}]", np.zeros(1)) for n in range(16)]
            begin = {n: y[0] for n, y in enumerate(each, 1) if np.ptp(y) > 0.0}
            idle = [n for n, y in begin.items() if y == min(begin.values())]
            main = idle if len(idle) == 4 else (1, 2, 3, 4)
            places[x] = [ports.get(101 + motor, ("MAIN", main[motor])) for motor in order]
            of[x] = [each[n - 1] for _, n in places[x]]
        stem = max(outputs, key=lambda x: sorted(np.std(np.nan_to_num(y)) for y in of[x]))  # gimbals do not move four
        pulses = {k: x for k, x in enumerate(of[stem]) if len(x) == len(streams[stem].time)}
        reached = np.concatenate([*pulses.values(), np.zeros(1)])
        least, most = float(np.nanmin(reached)), float(np.nanmax(reached))
        begun = float(np.nanmin(reached, where=reached > 0.0, initial=most))
        rest = min((float(np.nanmin(x)) for x in pulses.values()), default=900.0)  # of pulses, at least PWM_DISARMED
        set_up = parameters.get("DSHOT_CONFIG", 0.0) > 0.0 and min(rest, begun) < 800.0
        dshot = most < 2048.0 and (set_up or (most > 1000.0 and begun < 700.0))
        if least < 0.0:
            why = f"{stem} runs from {least:g} to {most:g}: no pulses in us"
            raise WrongMotors(f"{why}. Write the commands, 0 to 1, into a CSV, and give that.")
        for k, x in pulses.items():
            port, n = places[stem][k]
            names = [[f"PWM_{port}_{end}{n}", f"PWM_{port}_{end}", f"PWM_{end}"] for end in ("MIN", "MAX")]
            given = [[v for name in some if (v := parameters.get(name, -1.0)) > 0.0] for some in names]
            low, high = ([*x, at][0] for x, at in zip(given, (1000.0, 2000.0), strict=True))
            unit = "shares" if most <= 1.01 else "DShot" if dshot else "pulses"
            low, high = {"shares": (0.0, 1.0), "DShot": (0.0, 1999.0)}.get(unit, (low, high))
            if high > low:
                signals[f"actuator_outputs.signal[{k}]"] = np.where(x < low, 0.0, (x - low) / (high - low))
            said = f"{stem}, {unit} from {low:g} to {high:g}{' us' if unit == 'pulses' else ''}"
    if signals:
        streams[stem] = Stream(stem, streams[stem].time, {**streams[stem].columns, **signals})
    return f"motor commands are in {said}{', placed by CA_ROTOR' if placed else ''}"


class _Log:
    """What a file says, before any message is looked up by its name."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.formats: dict[str, list[tuple[str, int, str]]] = {}  # type, length (0: no array), field
        self.room = MAX_COLUMNS  # for those of subscribed messages
        self.subscriptions: list[_Subscription] = []
        self.current: dict[int, _Subscription] = {}
        self.parameters: dict[str, float] = {}
        self.dropouts: list[int] = []  # [ms]
        self.ends: list[int] = []  # where the autopilot appended after a crash
        self.damage = self.unread = 0
        self.flying = False  # whether the definitions are over

    def scan(self) -> None:
        """Take every message once, from the first byte to the last."""
        data, at = self.data, 16
        while at + 3 <= len(data):
            end = next((end for end in self.ends if end > at), len(data))
            if at + 3 > end:
                at = end
                continue
            size, kind = data[at] | data[at + 1] << 8, data[at + 2]
            stop = at + 3 + size
            good = stop <= end and kind in _KINDS
            self.flying = self.flying or (good and kind in b"ALC")
            try:
                if good:
                    self._take(kind, at + 3, stop)
            except (ValueError, IndexError, struct.error):
                good = False
            if not good:
                self.damage += 1
                if stop > end or (stop + 2 < end and data[stop + 2] not in _KINDS):  # its size is wrong, too
                    found = data.find(_SYNC, at + 1, end)
                    if found < 0:
                        self.unread += end - at
                    stop = end if found < 0 else found + len(_SYNC)
            at = stop
        self.unread += len(data) - at

    def _take(self, kind: int, start: int, stop: int) -> None:
        data = self.data
        if kind == ord("D"):
            subscription = self.current.get(data[start] | data[start + 1] << 8) if stop - start > 1 else None
            if subscription is None or subscription.record.itemsize != stop - start - 2:
                raise ValueError
            subscription.starts.append(start + 2)
        elif kind == ord("A"):
            instance, number = struct.unpack_from("<BH", data, start)
            message = data[start + 3 : stop].decode(errors="ignore")
            before = self.current.get(number)
            if before is None or (before.name, before.instance) != (message, instance):
                columns = list(itertools.islice(self._columns(message), self.room + 1))
                while columns and columns[-1][0].startswith("_padding"):  # which is not logged at the end
                    columns.pop()
                if len(columns) > self.room:
                    del self.formats[message]  # so that it is not unfolded again and again
                    raise ValueError
                self.current[number] = _Subscription(message, instance, np.dtype(columns), array("Q"))
                self.subscriptions.append(self.current[number])
                self.room -= len(columns)
        elif kind == ord("F") and not self.flying:
            message, _, fields = data[start:stop].decode(errors="ignore").partition(":")
            self.formats[message] = [(kind, int(length or 0), name) for kind, length, name in _FIELD.findall(fields)]
        elif kind == ord("P") and not self.flying:
            value = start + 1 + data[start]
            kind_of, _, key = data[start + 1 : value].decode(errors="ignore").partition(" ")
            if key not in self.parameters and kind_of in ("int32_t", "float"):
                (self.parameters[key],) = struct.unpack("<i" if kind_of == "int32_t" else "<f", data[value:stop])
        elif kind == ord("B"):
            flags, *offsets = struct.unpack_from("<8xB7x3Q", data, start)
            self.ends = sorted(offset for offset in offsets if flags & 1 and start < offset < len(data))
        elif kind == ord("O"):
            self.dropouts += struct.unpack("<H", data[start:stop])

    def _columns(self, message: str, prefix: str = "") -> Iterator[tuple[str, str]]:
        """The name and the type of each column of a message, with those of the messages in it."""
        if not self.formats.get(message) or prefix.count(".") > 9:
            raise ValueError
        for kind, length, name in self.formats[message]:
            for k in range(length or 1):
                place = f"{prefix}{name}{f'[{k}]' if length else ''}"
                if kind in _TYPES:
                    yield place, _TYPES[kind]
                else:
                    yield from self._columns(kind, f"{place}.")


def read_usd(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each kind of event."""
    notes = []
    body = data[:-4]
    if zlib.crc32(body) != int.from_bytes(data[-4:], "little"):
        # A card that is pulled out, or a battery that runs empty, leaves a file without its end.
        notes.append("the checksum of the uSD log does not match: the end of the file may be missing")
        body = data
    try:
        version, kinds = struct.unpack_from("<HH", body, 1)
        if version not in _TICKS:
            raise ValueError(f"version {version}, and 1 and 2 are known")
        (tick, unit), records, names, at = _TICKS[version], {}, {}, 5
        for _ in range(kinds):
            (kind,) = struct.unpack_from("<H", body, at)
            names[kind], at = _text(body, at + 2)
            (count,) = struct.unpack_from("<H", body, at)
            at += 2
            fields: list[tuple[str, Any]] = [("id", "<u2"), ("tick", tick)]
            for _ in range(count):
                variable, at = _text(body, at)
                found = _VARIABLE.fullmatch(variable)
                if found is None:
                    raise ValueError(f"a variable of unknown type, {shown(variable)}")
                fields.append((found[1], np.dtype(found[2]).newbyteorder("<")))
            records[kind] = np.dtype(fields)
    except (struct.error, ValueError) as error:
        raise UnreadableLog(
            f"{name} begins like a uSD log, but its header cannot be read: {error}. Copy it again, or export it as CSV."
        ) from error
    starts, sizes = {kind: array("Q") for kind in records}, {kind: record.itemsize for kind, record in records.items()}
    while at + 2 <= len(body):
        kind = body[at] | body[at + 1] << 8
        if kind not in records or at + sizes[kind] > len(body):
            break
        starts[kind].append(at)
        at += sizes[kind]
    if at < len(body):
        notes.append(f"the last {len(body) - at} bytes of the uSD log were not read: they are not whole events")
    streams = []
    for kind, record in records.items():
        rows = pick(body, starts[kind], record)
        values = {field: numbers(rows[field]) for field in record.names[2:]}
        streams.append(Stream(names[kind], rows["tick"] * unit, values | unpacked(values)))
    return streams, notes


PACKED = "stateEstimateZ.quat"


def unpacked(columns: Mapping[str, Array]) -> dict[str, Array]:
    """The columns of the quaternion that a Crazyflie packs into one (``quatcompress.h``): the top two bits name the
    largest component, which is positive; the others follow in ten bits each, a sign and a share of sqrt(1/2)."""
    if PACKED not in columns:
        return {}
    told = np.abs(columns[PACKED]) < 2**32
    code = np.where(told, columns[PACKED], 0.0).astype(np.int64).astype(np.uint64) & np.uint64(0xFFFFFFFF)
    largest = (code >> np.uint64(30)).astype(int)
    q = np.zeros((len(code), 4))
    for k in (3, 2, 1, 0):
        rows = largest != k
        part = (code[rows] & np.uint64(0x3FF)).astype(int)
        q[rows, k] = np.where(part >> 9, -1.0, 1.0) * (part & 0x1FF) / 511.0 * 0.5**0.5
        code[rows] >>= np.uint64(10)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(1.0 - (q * q).sum(-1), 0.0))
    return {f"stateEstimateZ.q{axis}": np.where(told, q[:, k], np.nan) for k, axis in enumerate("xyzw")}


def _text(body: bytes, at: int) -> tuple[str, int]:
    end = body.index(b"\0", at)
    return body[at:end].decode(), end + 1


def pick(data: bytes, starts: array, record: np.dtype) -> NDArray[np.void]:
    """The records (N) of one kind that begin at some places of the data."""
    if not starts:
        return np.empty(0, record)
    windows = sliding_window_view(np.frombuffer(data, np.uint8), record.itemsize)
    return windows[np.frombuffer(starts, np.uint64)].view(record)[:, 0]


# -- dataflash ---------------------------------------------------------------------------------------------------------

HEAD, _FMT = b"\xa3\x95", 128
_LETTERS = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8"}
_LETTERS |= {"f": "<f4", "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "a": "V64"}
_LETTERS |= {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4"}
_SCALES: dict[str, float] = {**dict.fromkeys("cCeE", 0.01), "L": 1e-7}
_MOTORS = (*range(33, 41), *range(82, 86))  # values of SERVOn_FUNCTION, of motors in their order
_FRAMES = {2: "six", 3: "eight", 4: "eight", 5: "six", 6: "one", 7: "three", 12: "twelve", 14: "ten"}  # FRAME_CLASS


def read_dataflash(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each message: columns ``NAME.field``, or ``NAME#1.field`` of its second instance or core; of an EKF
    that says which core is primary, ``NAME.field`` is of that one. Boots follow one another.

    ``RCOU.signal`` are the outputs that SERVOn_FUNCTION gives to motors 1 to 4, from MOT_PWM_MIN to MOT_PWM_MAX.

    Raises:
        LogError: it holds no message, or is not of a drone with four rotors.
    """
    kinds: dict[int, tuple[str, str, list[str], np.dtype]] = {}
    starts: dict[int, array] = {}
    boots, described = list[int](), set[int]()  # where each boot but the first begins; kinds that this one described
    at, lost = data.find(HEAD), 0
    while at >= 0 and at + 3 <= len(data):
        kind = data[at + 2]
        size = 89 if kind == _FMT else kinds[kind][3].itemsize + 3 if kind in kinds else 0
        if not size or at + size > len(data) or data[at : at + 2] != HEAD:
            found = data.find(HEAD, at + 1)
            lost, at = lost + (found if found > 0 else len(data)) - at, found
            continue
        if kind == _FMT:
            parts = (data[at + 5 : at + 9], data[at + 9 : at + 25], data[at + 25 : at + 89])
            message, letters, labels = (part.rstrip(b"\0").decode(errors="ignore") for part in parts)
            fields = labels.split(",")
            if set(letters) <= _LETTERS.keys() and len(set(fields)) == len(letters) == len(fields):
                record = np.dtype([(field, _LETTERS[letter]) for field, letter in zip(fields, letters, strict=True)])
                if record.itemsize + 3 == data[at + 4]:
                    kinds[data[at + 3]] = message, letters, fields, record
            if data[at + 3] in described:
                boots.append(at)
                described = set()
            described.add(data[at + 3])
        else:
            starts.setdefault(kind, array("Q")).append(at + 3)
        at += size
    streams, parameters, tables, spans = {}, {}, {}, np.tile([np.inf, -np.inf], (len(boots) + 1, 1))
    for kind, places in starts.items():
        message, letters, fields, record = kinds[kind]
        rows = pick(data, places, record)
        if message == "PARM" and {"Name", "Value"} <= set(fields):
            names = (x.decode(errors="ignore") for x in rows["Name"])
            parameters |= dict(zip(names, rows["Value"].tolist(), strict=True))
        scales = {x: _SCALES.get(y, 1.0) for x, y in zip(fields, letters, strict=True) if y not in "nNZa"}
        columns = {x: numbers(rows[x]) * scale for x, scale in scales.items()}
        if "TimeUS" in columns:
            tables[message] = np.searchsorted(boots, places), columns
            np.minimum.at(spans[:, 0], tables[message][0], columns["TimeUS"])
            np.maximum.at(spans[:, 1], tables[message][0], columns["TimeUS"])
    last, shifts = -np.inf, [0.0]
    for first, end in spans:  # a boot sets the clock back; what describes messages again need not be one
        shifts.append(shifts[-1] + (last + 1e7 if first + 1e6 < last else 0.0))
        last = end if end > -np.inf else last
    for boot, columns in tables.values():
        columns["TimeUS"] += np.array(shifts[1:])[boot]
    for message, (_, columns) in tables.items():
        time = columns["TimeUS"]
        which = next((columns[x] for x in ("I", "C", "Inst", "Instance") if x in columns), np.zeros(len(time)))
        some = np.unique(which).astype(int) if message != "RCOU" else [0]
        parts = {f"{message}#{k}" if k else message: which == k for k in some}
        _, ekf = tables.get(f"{message[:2]}F4", (0, {}))
        if "C" in columns and "PI" in ekf:  # which core the autopilot flew by
            primary = ekf["PI"][np.maximum(np.searchsorted(ekf["TimeUS"], time, "right") - 1, 0)]
            parts |= {message: which == primary} if (which == primary).any() else {}
        for stem, own in parts.items():
            values = {f"{stem}.{field}": x[own] for field, x in columns.items()}
            streams[stem] = Stream(stem, time[own] * 1e-6, values)
    if not streams:
        raise UnreadableLog(f"{name} is not a readable dataflash log: it holds no message with a time. Copy it again.")
    notes = [f"the dataflash log is damaged: {lost} bytes were not read"] if lost else []
    if (flown := len(set(shifts))) > 1:
        notes.append(f"the log holds {flown} boots: they follow one another, 10 s apart")
    if "RCOU" in streams:
        streams["RCOU"] = _with_signals(streams["RCOU"], parameters, name, notes)
    return list(streams.values()), notes


def _with_signals(outputs: Stream, parameters: Mapping[str, float], name: str, notes: list[str]) -> Stream:
    servos = {key: re.fullmatch(r"SERVO(\d+)_FUNCTION", key) for key in parameters}
    assigned = {int(found[1]): parameters[key] for key, found in servos.items() if found and parameters[key] > 0.0}
    functions = {_MOTORS.index(int(value)): n for n, value in assigned.items() if value in _MOTORS}  # outputs of motors
    wings = "Q_ENABLE says that it has wings" if parameters.get("Q_ENABLE", 0.0) else ""
    few = "its SERVO functions lack one of motors 1 to 4" if assigned and not {0, 1, 2, 3} <= functions.keys() else ""
    if wings or few:
        raise WrongMotors(f"{name} is not the log of a quadrotor: {wings or few}. Only quadrotors are fitted.")
    frame = int(parameters.get("FRAME_CLASS", 1))
    if frame in _FRAMES or len(functions) > 4:
        many = _FRAMES.get(frame, str(len(functions)))
        said = f"{name} is the log of a drone with {many} rotors (FRAME_CLASS {frame})."
        raise WrongMotors(f"{said} Only four are fitted.")
    throttle = f"RC{parameters.get('RCMAP_THROTTLE', 3):g}"  # whose range counts where MOT_PWM_MIN is 0
    ends = [(f"MOT_PWM_{x}", f"{throttle}_{x}") for x in ("MIN", "MAX")]
    low, high = (next((parameters[x] for x in names if parameters.get(x)), 0.0) for names in ends)
    low, high = (low or 1000.0), (high if high > low else 2000.0)
    signals = dict(outputs.columns)
    for k in range(4):
        pulses = outputs.columns.get(f"RCOU.C{functions.get(k, k + 1)}")
        if pulses is not None:
            signals[f"RCOU.signal[{k}]"] = np.maximum((pulses - low) / (high - low), 0.0)
    notes.append(f"motor commands are outputs of RCOU, pulses from {low:g} to {high:g} us")
    return Stream(outputs.name, outputs.time, signals)
