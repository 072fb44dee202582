"""The log of a PX4 autopilot."""

from __future__ import annotations

import io

import numpy as np

from torchrl_quad.deploy.frames import motor_signal
from torchrl_quad.identification.errors import UnreadableLog
from torchrl_quad.identification.streams import Stream


def read_ulog(data: bytes, name: str) -> tuple[list[Stream], list[str]]:
    """A stream for each message: columns ``message.field``, or ``message#1.field`` of its second instance.

    Where a message says when its data were sampled, that is its time. A motor that is stopped has the command 0.
    ``actuator_motors.signal`` is what leaves for the motors: PX4 undoes the thrust curve of THR_MDL_FAC after it has
    logged ``actuator_motors.control`` (``FunctionMotors.hpp``).

    Raises:
        UnreadableLog: the file is broken, or pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ModuleNotFoundError as error:
        raise UnreadableLog("A ULog needs pyulog. Write: pip install '.[logs]' in a clone.") from error
    try:
        log = ULog(io.BytesIO(data))
    except Exception as error:  # pyulog raises whatever its parser meets in a broken file
        raise UnreadableLog(f"{name} is no readable ULog: {error}. Copy it again.") from error
    notes = []
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) / 1000.0
        notes.append(f"the logger lost {lost:.2f} s in {len(log.dropouts)} dropouts: gaps where samples are missing")
    curve = float(log.initial_parameters.get("THR_MDL_FAC", 0.0))
    streams = []
    for message in log.data_list:
        stem = message.name + (f"#{message.multi_id}" if message.multi_id else "")
        columns = {f"{stem}.{field}": values for field, values in message.data.items()}
        sampled = message.data.get("timestamp_sample")
        time = message.data["timestamp"] if sampled is None or not sampled.all() else sampled
        if message.name == "actuator_motors":
            for k in range(4):
                control = np.nan_to_num(columns[f"{stem}.control[{k}]"].astype(float))
                columns[f"{stem}.signal[{k}]"] = motor_signal(control, curve)
        streams.append(Stream(stem, time * 1e-6, columns))
    if "actuator_motors" not in {stream.name for stream in streams}:
        notes.append("no actuator_motors: motor commands are actuator_outputs, taken as 1000 to 2000 us")
    elif curve:
        notes.append(f"motor commands are what is left after the thrust curve of THR_MDL_FAC = {curve:g}")
    return streams, notes
