"""The logs of servos that Rhoban/bam publishes, as tables."""

import csv
import io
import json

_COLUMNS = {  # of the table: field of the log, and decimals
    "t_s": ("timestamp", 6),
    "goal_rad": ("goal_position", 6),
    "pos_rad": ("position", 6),
    "speed_rad_s": ("speed", 6),
    "load": ("load", 3),
    "volts": ("input_volts", 3),
    "temp_C": ("temp", 1),
    "torque_enable": ("torque_enable", None),
}


def bam_table(log: bytes) -> bytes:
    """The CSV table of a JSON log; ValueError if it is none."""
    try:
        entries = json.loads(log)["entries"]
        rows = [[round(entry[field], digits) for field, digits in _COLUMNS.values()] for entry in entries]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"no log of a servo ({error!r})") from error
    text = io.StringIO(newline="")
    csv.writer(text).writerows([_COLUMNS, *rows])
    return text.getvalue().encode()
