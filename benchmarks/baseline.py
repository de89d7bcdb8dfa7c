# SPDX-License-Identifier: BSD-3-Clause
"""A naive rosbridge server, to compare with: how such a bridge is written when nothing is done for speed.

rospy deserializes each message in a thread per connection; the message is taken apart into dictionaries recursively and
written by json.dumps, for every client anew; the text is handed to Tornado's write_message on the event loop. It knows
advertise, publish, subscribe and call_service in JSON, and cbor and cbor-raw subscriptions. It stands in for bridges of
that build in measurements; it is no other bridge's code.
"""

from __future__ import annotations

import argparse
import base64
import json
import threading
from typing import Any, Callable, ClassVar, Dict, List, Set, Tuple, Union

import cbor2
import genpy
import roslib.message
import rospy
import rosservice
import tornado.ioloop
import tornado.web
import tornado.websocket

Encode = Callable[[str, Any], Union[str, bytes]]
TIMES = ("time", "duration")


def to_values(message: Any, binary: Callable[[bytes], Any]) -> Dict[str, Any]:
    """A message as dictionaries and lists; `binary` makes a value of uint8[]."""
    return {
        name: _to_value(getattr(message, name), kind, binary)
        for name, kind in zip(message.__slots__, message._slot_types)
    }


def _to_value(value: Any, kind: str, binary: Callable[[bytes], Any]) -> Any:
    if kind in TIMES:
        return {"secs": value.secs, "nsecs": value.nsecs}
    if "[" in kind:
        element = kind[: kind.index("[")]
        if element in ("uint8", "char"):
            return binary(bytes(value))
        return [_to_value(item, element, binary) for item in value]
    if genpy.base.is_simple(kind) or kind == "string":
        return value
    return to_values(value, binary)


def populate(message: Any, values: Dict[str, Any]) -> Any:
    """Sets the fields of a message that are in `values`."""
    for name, kind in zip(message.__slots__, message._slot_types):
        if name in values:
            setattr(message, name, _from_value(values[name], kind))
    return message


def _from_value(value: Any, kind: str) -> Any:
    if kind in TIMES:
        make = genpy.Time if kind == "time" else genpy.Duration
        return make(value.get("secs", 0), value.get("nsecs", 0))
    if "[" in kind:
        element = kind[: kind.index("[")]
        if element in ("uint8", "char") and isinstance(value, str):
            return base64.b64decode(value)
        return [_from_value(item, element) for item in value]
    if genpy.base.is_simple(kind) or kind == "string":
        return value
    kind = "std_msgs/Header" if kind == "Header" else kind
    return populate(roslib.message.get_message_class(kind)(), value)


def encode_json(topic: str, message: Any) -> str:
    values = to_values(message, lambda data: base64.b64encode(data).decode())
    return json.dumps({"op": "publish", "topic": topic, "msg": values})


def encode_cbor(topic: str, message: Any) -> bytes:
    return cbor2.dumps({"op": "publish", "topic": topic, "msg": to_values(message, bytes)})


def encode_cbor_raw(topic: str, message: Any) -> bytes:
    now = rospy.get_rostime()
    raw = {"secs": now.secs, "nsecs": now.nsecs, "bytes": message._buff}
    return cbor2.dumps({"op": "publish", "topic": topic, "msg": raw})


ENCODERS: Dict[str, Encode] = {"none": encode_json, "cbor": encode_cbor, "cbor-raw": encode_cbor_raw}


class Topics:
    """One rospy subscriber per topic and kind of message, whatever the number of its clients."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clients: Dict[Tuple[str, bool], Set[Tuple[Client, str]]] = {}
        self._subscribers: Dict[Tuple[str, bool], Any] = {}

    def subscribe(self, client: Client, topic: str, type_name: str, compression: str) -> None:
        key = (topic, compression == "cbor-raw")
        with self._lock:
            self._clients.setdefault(key, set()).add((client, compression))
        if key not in self._subscribers:
            kind = rospy.AnyMsg if key[1] else roslib.message.get_message_class(type_name)
            self._subscribers[key] = rospy.Subscriber(topic, kind, lambda message: self._send(key, message))

    def forget(self, client: Client) -> None:
        with self._lock:
            for key, clients in list(self._clients.items()):
                clients -= {entry for entry in clients if entry[0] is client}
                if not clients:
                    del self._clients[key]
                    self._subscribers.pop(key).unregister()

    def _send(self, key: Tuple[str, bool], message: Any) -> None:
        with self._lock:
            clients = list(self._clients.get(key, ()))
        for client, compression in clients:
            client.send(ENCODERS[compression](key[0], message))


class Client(tornado.websocket.WebSocketHandler):
    """A websocket client."""

    topics = Topics()
    publishers: ClassVar[Dict[str, Any]] = {}

    def check_origin(self, origin: str) -> bool:
        return True

    def open(self, *_: str, **__: str) -> None:
        self.set_nodelay(True)
        self._loop = tornado.ioloop.IOLoop.current()

    def on_message(self, message: Union[str, bytes]) -> None:
        operation = json.loads(message)
        {
            "advertise": self._advertise,
            "publish": self._publish,
            "subscribe": self._subscribe,
            "call_service": self._call_service,
        }[operation["op"]](operation)

    def on_close(self) -> None:
        self.topics.forget(self)

    def send(self, data: Union[str, bytes]) -> None:
        """Sends a message, from any thread."""
        self._loop.add_callback(self._write, data)

    async def _write(self, data: Union[str, bytes]) -> None:
        try:
            await self.write_message(data, binary=isinstance(data, bytes))
        except tornado.websocket.WebSocketClosedError:
            self.topics.forget(self)

    def _subscribe(self, operation: Dict[str, Any]) -> None:
        compression = operation.get("compression", "none")
        self.topics.subscribe(self, operation["topic"], operation["type"], compression)

    def _advertise(self, operation: Dict[str, Any]) -> None:
        kind = roslib.message.get_message_class(operation["type"])
        self.publishers[operation["topic"]] = rospy.Publisher(operation["topic"], kind, queue_size=100)

    def _publish(self, operation: Dict[str, Any]) -> None:
        publisher = self.publishers[operation["topic"]]
        publisher.publish(populate(publisher.data_class(), operation["msg"]))

    def _call_service(self, operation: Dict[str, Any]) -> None:
        threading.Thread(target=self._call, args=(operation,), daemon=True).start()

    def _call(self, operation: Dict[str, Any]) -> None:
        kind = rosservice.get_service_class_by_name(operation["service"])
        response = rospy.ServiceProxy(operation["service"], kind)(
            populate(kind._request_class(), operation.get("args", {}))
        )
        values = to_values(response, lambda data: base64.b64encode(data).decode())
        answer = {"op": "service_response", "service": operation["service"], "values": values, "result": True}
        self.send(json.dumps({**answer, "id": operation.get("id")}))


def main(arguments: List[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, required=True)
    options = parser.parse_args(arguments)
    rospy.init_node("rosbridge_baseline", anonymous=True, disable_signals=True)
    tornado.web.Application([(r"/", Client)]).listen(options.port, "127.0.0.1")
    tornado.ioloop.IOLoop.current().start()


if __name__ == "__main__":
    import sys

    main(rospy.myargv(sys.argv)[1:])
