"""ArduPilot's dataflash log, which describes itself: each message FMT says how one kind of message is packed
(https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html, ``AP_Logger/LogStructure.h``)."""

from __future__ import annotations

import re
from array import array
from collections.abc import Mapping

import numpy as np

from torchrl_quad.identification.autopilots import numbers, pick
from torchrl_quad.identification.errors import UnreadableLog, WrongMotors
from torchrl_quad.identification.signals import Stream

HEAD, _FMT = b"\xa3\x95", 128
_TYPES = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8"}
_TYPES |= {"f": "<f4", "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "a": "V64"}
_TYPES |= {"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4"}
_SCALES: dict[str, float] = {**dict.fromkeys("cCeE", 0.01), "L": 1e-7}
_MOTORS = (*range(33, 41), *range(82, 86))  # values of SERVOn_FUNCTION, of motors in their order
_FRAMES = {2: "six", 3: "eight", 4: "eight", 5: "six", 6: "one", 7: "three", 12: "twelve", 14: "ten"}  # FRAME_CLASS


def read_dataflash(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each message: columns ``NAME.field``, or ``NAME#1.field`` of its second instance or core.

    ``RCOU.signal`` are the outputs that SERVOn_FUNCTION gives to motors 1 to 4, from MOT_PWM_MIN to MOT_PWM_MAX.

    Raises:
        LogError: it holds no message, or is not of a drone with four rotors.
    """
    kinds: dict[int, tuple[str, str, list[str], np.dtype]] = {}
    starts: dict[int, array] = {}
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
            if set(letters) <= _TYPES.keys() and len(set(fields)) == len(letters) == len(fields):
                record = np.dtype([(field, _TYPES[letter]) for field, letter in zip(fields, letters, strict=True)])
                if record.itemsize + 3 == data[at + 4]:
                    kinds[data[at + 3]] = message, letters, fields, record
        else:
            starts.setdefault(kind, array("Q")).append(at + 3)
        at += size
    streams, parameters = {}, {}
    for kind, places in starts.items():
        message, letters, fields, record = kinds[kind]
        rows = pick(data, places, record)
        if message == "PARM" and {"Name", "Value"} <= set(fields):
            names = (x.decode(errors="ignore") for x in rows["Name"])
            parameters |= dict(zip(names, rows["Value"].tolist(), strict=True))
        if "TimeUS" not in fields:
            continue
        columns = {
            field: numbers(rows[field]) * _SCALES.get(letter, 1.0)
            for field, letter in zip(fields, letters, strict=True)
            if letter not in "nNZa"
        }
        which = next((columns[x] for x in ("I", "C", "Inst", "Instance") if x in columns), np.zeros(len(rows)))
        for k in np.unique(which).astype(int) if message != "RCOU" else [0]:
            own = which == k
            stem = f"{message}#{k}" if k else message
            values = {f"{stem}.{field}": x[own] for field, x in columns.items()}
            streams[stem] = Stream(stem, columns["TimeUS"][own] * 1e-6, values)
    if not streams:
        raise UnreadableLog(f"{name} is not a readable dataflash log: it holds no message with a time. Copy it again.")
    notes = [f"the dataflash log is damaged: {lost} bytes were not read"] if lost else []
    if "RCOU" in streams:
        streams["RCOU"] = _with_signals(streams["RCOU"], parameters, name, notes)
    return list(streams.values()), notes


def _with_signals(outputs: Stream, parameters: Mapping[str, float], name: str, notes: list[str]) -> Stream:
    functions = {}  # the outputs of motors
    for key, value in parameters.items():
        found = re.fullmatch(r"SERVO(\d+)_FUNCTION", key)
        if found and value in _MOTORS:
            functions[_MOTORS.index(int(value))] = int(found[1])
    frame = int(parameters.get("FRAME_CLASS", 1))
    if frame in _FRAMES or len(functions) > 4:
        many = _FRAMES.get(frame, str(len(functions)))
        said = f"{name} is the log of a drone with {many} rotors (FRAME_CLASS {frame})."
        raise WrongMotors(f"{said} Only four are fitted.")
    low, high = parameters.get("MOT_PWM_MIN", 0.0), parameters.get("MOT_PWM_MAX", 0.0)
    low, high = (low or 1000.0), (high if high > low else 2000.0)
    signals = dict(outputs.columns)
    for k in range(4):
        pulses = outputs.columns.get(f"RCOU.C{functions.get(k, k + 1)}")
        if pulses is not None:
            signals[f"RCOU.signal[{k}]"] = np.maximum((pulses - low) / (high - low), 0.0)
    notes.append(f"motor commands are outputs of RCOU, pulses from {low:g} to {high:g} us")
    return Stream(outputs.name, outputs.time, signals)
