"""ROS 2 bags of joint states, written by rosbags."""

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.LATEST)
TYPE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND


def state(t, names, q=(), qd=(), tau=(), *, receipt=None):
    """(topicless) row of a topic: stamp in s from the beginning, names, fields, and time of receipt if it differs."""
    return t, list(names), q, qd, tau, t if receipt is None else receipt


def write_bag(path, topics, *, mcap=False, stamped=True, others=()):
    """Writes rows of `state` by topic, and one message of text for each topic in `others`."""
    storage = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    Header, Time, JointState = (
        STORE.types[f"{name}"] for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", TYPE)
    )
    with Writer(path, version=9, storage_plugin=storage) as writer:
        rows = []
        for topic, of in topics.items():
            connection = writer.add_connection(topic, TYPE, typestore=STORE)
            for t, names, q, qd, tau, receipt in of:
                seconds, rest = divmod(BEGIN + round(t * SECOND), SECOND) if stamped else (0, 0)
                fields = (np.asarray(values, float) for values in (q, qd, tau))
                message = JointState(Header(Time(seconds, rest), ""), names, *fields)
                rows.append((BEGIN + round(receipt * SECOND), connection, STORE.serialize_cdr(message, TYPE)))
        for topic in others:
            connection = writer.add_connection(topic, TEXT, typestore=STORE)
            rows.append((BEGIN, connection, STORE.serialize_cdr(STORE.types[TEXT]("words"), TEXT)))
        for receipt, connection, raw in sorted(rows, key=lambda row: row[0]):
            writer.write(connection, receipt, raw)
    return path
