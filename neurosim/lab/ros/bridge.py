"""A virtual rosbridge: operations of its protocol, and the few types and nodes of a small graph.

After rosbridge_suite for ROS 2 (rosbridge_library/capabilities, internal/message_conversion.py,
internal/publishers.py) and its rosapi. It shares no code with the driver. It logs messages that it
rejects, as that server does. It can also send a ``status``, as the protocol's document says and
other servers do.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

#: Fields of the types of messages; a name with a slash is a type of its own.
TYPES: dict[str, dict[str, str]] = {
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "geometry_msgs/Vector3": dict.fromkeys("xyz", "float64"),
    "geometry_msgs/Point": dict.fromkeys("xyz", "float64"),
    "geometry_msgs/Quaternion": dict.fromkeys("xyzw", "float64"),
    "geometry_msgs/Pose": {
        "position": "geometry_msgs/Point",
        "orientation": "geometry_msgs/Quaternion",
    },
    "geometry_msgs/Twist": dict.fromkeys(("linear", "angular"), "geometry_msgs/Vector3"),
    "geometry_msgs/TwistStamped": {"header": "std_msgs/Header", "twist": "geometry_msgs/Twist"},
    "geometry_msgs/PoseWithCovariance": {"pose": "geometry_msgs/Pose", "covariance": "float64[36]"},
    "geometry_msgs/TwistWithCovariance": {
        "twist": "geometry_msgs/Twist",
        "covariance": "float64[36]",
    },
    "sensor_msgs/LaserScan": {
        "header": "std_msgs/Header",
        **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "float32"),
        **dict.fromkeys(("time_increment", "scan_time", "range_min", "range_max"), "float32"),
        **dict.fromkeys(("ranges", "intensities"), "float32[]"),
    },
    "nav_msgs/Odometry": {
        "header": "std_msgs/Header",
        "child_frame_id": "string",
        "pose": "geometry_msgs/PoseWithCovariance",
        "twist": "geometry_msgs/TwistWithCovariance",
    },
}
#: Default value of each primitive type, and the types of JSON that it accepts.
_PRIMITIVES: dict[str, tuple[Any, tuple[type, ...]]] = {
    "float64": (0.0, (int, float)),
    "float32": (0.0, (int, float)),
    "float32[]": ([], (list,)),
    "int32": (0, (int,)),
    "uint32": (0, (int,)),
    "string": ("", (str,)),
    "float64[36]": ([0.0] * 36, (list,)),
}
#: Fields of each operation: the required and the optional ones.
_FIELDS: dict[str, tuple[dict[str, type], dict[str, type]]] = {
    "advertise": ({"topic": str, "type": str}, {"latch": bool, "queue_size": int, "qos": dict}),
    "unadvertise": ({"topic": str}, {}),
    "publish": ({"topic": str}, {"type": str, "msg": dict}),
    "subscribe": (
        {"topic": str},
        {"type": str, "throttle_rate": int, "queue_length": int, "compression": str},
    ),
    "unsubscribe": ({"topic": str}, {}),
    "call_service": ({"service": str}, {"compression": str}),
}


class Refused(Exception):
    """A message that the bridge does not accept."""


@dataclass
class Topic:
    """A topic of the graph.

    Attributes:
        kind: type of its messages.
        subscribers, publishers: nodes of the robot.
        take: what the robot does with a message, if it subscribes.
    """

    kind: str
    subscribers: list[str] = field(default_factory=list)
    publishers: list[str] = field(default_factory=list)
    take: Callable[[dict[str, Any]], None] | None = None


@dataclass
class _Subscription:
    every: float
    last: float = -math.inf


class RosBridge:
    """Takes the messages of one client, and returns the answers.

    Args:
        topics: the robot's topics, by name.
        now: the time, s.
        statuses: whether it tells the client which messages it rejects.
        rosapi: whether the node with the services runs.

    Attributes:
        log: the rejected messages.
    """

    def __init__(
        self,
        topics: dict[str, Topic],
        now: Callable[[], float],
        *,
        statuses: bool = False,
        rosapi: bool = True,
    ):
        self.topics = topics
        self.log: list[str] = []
        self._now, self._statuses, self._rosapi = now, statuses, rosapi
        self._own = set(topics)
        self.leave()

    def leave(self) -> None:
        """Forget the client, as it leaves."""
        self._advertised: set[str] = set()
        self._subscribed: dict[str, _Subscription] = {}
        for name in set(self.topics) - self._own:
            del self.topics[name]

    def take(self, text: str) -> list[str]:
        """Take a message; return the answer."""
        try:
            message = json.loads(text)
        except ValueError:
            return []
        if not isinstance(message, dict):
            return []
        operation = message.get("op")
        try:
            if operation is None:
                raise Refused("Received a message without an op.")
            if operation not in _FIELDS:
                raise Refused(
                    f"Unknown operation: {operation}.  Allowed operations: {list(_FIELDS)}"
                )
            try:
                _check_fields(message, *_FIELDS[operation])
                return getattr(self, f"_{operation}")(message)
            except Refused as error:
                raise Refused(f"{operation}: {error}") from None
        except Refused as error:
            self.log.append(str(error))
            status = {"op": "status", "level": "error", "msg": str(error)}
            if "id" in message:
                status["id"] = message["id"]
            return [json.dumps(status)] if self._statuses else []

    def is_subscribed(self, name: str) -> bool:
        """Return whether the client has subscribed to a topic."""
        return name in self._subscribed

    def publish(self, name: str, message: dict[str, Any]) -> list[str]:
        """Return the bytes for the client when the robot publishes a message."""
        subscription = self._subscribed.get(name)
        # A little less, or rounding would leave out every other message.
        if subscription is None or self._now() - subscription.last < subscription.every - 1e-6:
            return []
        subscription.last = self._now()
        made = _finite(populate(message, self.topics[name].kind))
        return [json.dumps({"op": "publish", "topic": name, "msg": made})]

    def _advertise(self, message: dict[str, Any]) -> list[str]:
        name, kind = message["topic"], _plain(message["type"])
        if kind not in TYPES:
            raise Refused(f"Unable to import {message['type']} from package")
        if (there := self.topics.get(name)) is None:
            self.topics[name] = Topic(_full(kind))
        elif _plain(there.kind) != kind:
            raise Refused(
                f"Tried to register topic {name} with type {_full(kind)} but it is already "
                f"established with type {there.kind}"
            )
        self._advertised.add(name)
        return []

    def _unadvertise(self, message: dict[str, Any]) -> list[str]:
        self._advertised.discard(message["topic"])
        return []

    def _publish(self, message: dict[str, Any]) -> list[str]:
        name = message["topic"]
        topic = self.topics.get(name)
        if name not in self._advertised:
            if topic is None:
                raise Refused(
                    f"Cannot infer topic type for topic {name} as it is not yet advertised"
                )
            self._advertised.add(name)
        assert topic is not None
        made = populate(message.get("msg", {}), topic.kind, self._now())
        if topic.take is not None:
            topic.take(made)
        return []

    def _subscribe(self, message: dict[str, Any]) -> list[str]:
        name, kind = message["topic"], message.get("type")
        topic = self.topics.get(name)
        if topic is None and kind is None:
            raise Refused(f"Cannot infer topic type for topic {name} as it is not yet advertised")
        if topic is not None and kind is not None and _plain(topic.kind) != _plain(kind):
            raise Refused(
                f"Tried to register topic {name} with type {kind} but it is already established "
                f"with type {topic.kind}"
            )
        self._subscribed[name] = _Subscription(message.get("throttle_rate", 0) / 1000)
        return []

    def _unsubscribe(self, message: dict[str, Any]) -> list[str]:
        self._subscribed.pop(message["topic"], None)
        return []

    def _call_service(self, message: dict[str, Any]) -> list[str]:
        service, arguments = message["service"], message.get("args", {})
        answer = {"op": "service_response", "service": service}
        if "id" in message:
            answer["id"] = message["id"]
        values = self._rosapi_values(service, arguments) if self._rosapi else None
        if values is None:
            answer |= {"result": False, "values": f"Service {service} does not exist"}
        else:
            answer |= {"result": True, "values": values}
        return [json.dumps(answer)]

    def _rosapi_values(self, service: str, arguments: Any) -> dict[str, Any] | None:
        name = arguments.get("topic", "") if isinstance(arguments, dict) else ""
        topic = self.topics.get(name)
        if service == "/rosapi/topic_type":
            return {"type": "" if topic is None else topic.kind}
        if service == "/rosapi/subscribers":
            own = ["/rosbridge_websocket"] if name in self._subscribed else []
            return {"subscribers": ([] if topic is None else topic.subscribers) + own}
        if service == "/rosapi/publishers":
            own = ["/rosbridge_websocket"] if name in self._advertised else []
            return {"publishers": ([] if topic is None else topic.publishers) + own}
        return None


def populate(message: Any, kind: str, now: float | None = None) -> dict[str, Any]:
    """Return a message of a type with all of its fields.

    Args:
        message: some of its fields.
        kind: its type.
        now: time for a header without one, s.

    Raises:
        Refused: in rosbridge's words, if a field is not of the type.
    """
    return _object(message, _plain(kind), _plain(kind), [], now)


def _object(
    message: Any, kind: str, root: str, path: list[str], now: float | None
) -> dict[str, Any]:
    if not isinstance(message, dict):
        if not path:
            raise Refused(f"Expected a JSON object for type {root} but received a {type(message)}")
        raise _mismatch(root, kind, path, message)
    fields, made = TYPES[kind], {}
    for name in message:
        if name not in fields:
            raise Refused(f"Message type {root} does not have a field {'.'.join([*path, name])}")
    for name, inner in fields.items():
        if inner in TYPES:
            # A header that is left out keeps the time 0.
            then = now if name in message else None
            made[name] = _object(message.get(name, {}), inner, root, [*path, name], then)
            continue
        default, takes = _PRIMITIVES[inner]
        value = message.get(name, default)
        if not isinstance(value, takes) or (isinstance(value, bool) and inner != "float64"):
            raise _mismatch(root, inner, [*path, name], value)
        made[name] = float(value) if inner in ("float32", "float64") else value
    if kind == "std_msgs/Header" and now is not None and "stamp" not in message:
        made["stamp"] = {"sec": int(now), "nanosec": round(1e9 * (now % 1))}
    return made


def _finite(value: Any) -> Any:
    """Return a message for JSON: infinity and NaN become null."""
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _mismatch(root: str, expected: str, path: list[str], value: Any) -> Refused:
    return Refused(
        f"{root} message requires a {expected} for field {'.'.join(path)}, but got a {type(value)}"
    )


def _check_fields(
    message: dict[str, Any], needed: dict[str, type], others: dict[str, type]
) -> None:
    for name, kind in {**needed, **others}.items():
        if name not in message:
            if name in needed:
                raise Refused(f"Expected a {name} field but none was found.")
        elif not isinstance(message[name], kind):
            raise Refused(
                f"Expected field {name} to be one of {(kind,)}. Invalid value: {message[name]}"
            )


def _plain(kind: str) -> str:
    return kind.replace("/msg/", "/")


def _full(kind: str) -> str:
    return _plain(kind).replace("/", "/msg/")
