# SPDX-License-Identifier: BSD-3-Clause
"""Keeps the ROS master's view of this node equal to what the node wants.

rospy registers a topic or service by calling the master from whichever thread made it, holding rospy's topic lock, and
tries for ever while the master is away; and after a master restarts, empty, nothing is registered again. A `Registrar`
takes rospy's place: rospy's listener calls only note what is wanted, and one thread brings the master in line with it,
with a deadline per call. Every `CHECK_INTERVAL_S` that thread asks the master whether it still knows this node, and
registers everything anew when it doesn't.

This is one of the doors to ROS threads: what is wanted is guarded by a condition variable, everything else belongs to
the registrar's thread.
"""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future
from typing import Dict, List, NamedTuple, Optional, Set, Union

from rospy.impl.registration import (
    Registration,
    RegistrationListener,
    RegManager,
    get_registration_listeners,
    get_service_manager,
    get_topic_manager,
)

from rosbridge_library.ros.master import Master, MasterError, MasterUnreachable

logger = logging.getLogger("rosbridge.registrar")

CHECK_INTERVAL_S = 1.0
CLOSE_TIMEOUT_S = 1.0


class Entry(NamedTuple):
    """One registration: a publisher ("pub"), subscriber ("sub") or service ("srv") of this node."""

    kind: str
    name: str


class Registrar(RegistrationListener):  # type: ignore[misc]  # rospy has no types
    """Registers this node's topics and services with the master, now and whenever the master comes back.

    Call `install` once, after rospy.init_node; `close` ends the thread.
    """

    def __init__(self, master: Master) -> None:
        self._master = master
        self._changed = threading.Condition()
        self._wanted: Dict[Entry, str] = {}  # topic type, or service uri
        self._stale: Set[Entry] = set()  # removed, or added anew, since the thread last looked
        self._peers: Dict[Entry, List[str]] = {}  # what the master answered to each registration
        self._waiting: Dict[Entry, List[Future[List[str]]]] = {}
        self._closed = False
        self._known: Dict[Entry, str] = {}  # what the master has been told; the thread's own
        self._reg_manager: Optional[RegManager] = None
        self._thread = threading.Thread(target=self._run, name="registrar", daemon=True)
        self.trouble: Optional[str] = None
        """Why the master can't be told now, or None."""
        self.generation = 0
        """How often the master was found to have forgotten this node: it was started anew each time."""

    @property
    def rospy_registration(self) -> RegManager:
        """rospy's own registration object, which still connects subscribers to the publishers it is told of."""
        if self._reg_manager is None:
            raise RuntimeError("the registrar is not installed")
        return self._reg_manager

    def install(self) -> None:
        """Take over from rospy's registration listener. Raises RuntimeError before rospy.init_node."""
        listeners = get_registration_listeners()
        with listeners.lock:
            self._reg_manager = next((each for each in listeners.listeners if isinstance(each, RegManager)), None)
            if self._reg_manager is None:
                raise RuntimeError("rospy.init_node has not been called, or this node is shutting down")
            listeners.listeners[:] = [each for each in listeners.listeners if each is not self._reg_manager] + [self]
        for kind, registered in (
            (Registration.PUB, get_topic_manager().get_publications()),
            (Registration.SUB, get_topic_manager().get_subscriptions()),
            (Registration.SRV, get_service_manager().get_services()),
        ):
            for name, type_or_uri in registered:
                self._known[Entry(kind, name)] = self._wanted[Entry(kind, name)] = type_or_uri
                if kind == Registration.PUB:
                    self._stale.add(Entry(kind, name))  # registered again, to know who subscribes: see `settled`
        self._thread.start()

    def close(self) -> None:
        """End the thread once it has unregistered what was removed; blocks until then, or for `CLOSE_TIMEOUT_S`.

        What is registered stays so: rospy unregisters it all in one call when it shuts down.
        """
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(CLOSE_TIMEOUT_S)

    def settled(self, kind: str, name: str) -> Future[List[str]]:
        """Done once the master has been told of this registration; then the uris of the nodes at the other end.

        For a publisher these are its subscribers, for a subscriber its publishers. Fails with MasterError when the
        master refuses it; stays open while the master can't be reached.
        """
        future: Future[List[str]] = Future()
        entry = Entry(kind, name)
        with self._changed:
            if entry in self._peers:
                future.set_result(self._peers[entry])
            else:
                self._waiting.setdefault(entry, []).append(future)
        return future

    def renew(self, kind: str, name: str) -> None:
        """Register again what is registered: rospy then connects to a topic's publishers anew."""
        with self._changed:
            self._stale.add(Entry(kind, name))
            self._changed.notify()

    # rospy's listener interface, called under rospy's locks: must not block.

    def reg_added(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        entry = Entry(reg_type, resolved_name)
        with self._changed:
            self._wanted[entry] = data_type_or_uri
            self._peers.pop(entry, None)
            self._stale.add(entry)
            self._changed.notify()

    def reg_removed(self, resolved_name: str, data_type_or_uri: str, reg_type: str) -> None:
        entry = Entry(reg_type, resolved_name)
        with self._changed:
            if reg_type == Registration.SRV and self._wanted.get(entry) != data_type_or_uri:
                return  # an older provider of a name that has been taken over
            self._wanted.pop(entry, None)
            self._peers.pop(entry, None)
            self._stale.add(entry)
            waiting = self._waiting.pop(entry, [])
            self._changed.notify()
        for future in waiting:
            future.cancel()

    # The thread.

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._stale or self.trouble:
                    self._changed.wait(CHECK_INTERVAL_S)
                closed = self._closed
                wanted, stale = dict(self._wanted), self._stale
                self._stale = set()
            try:
                self._reconcile(wanted, stale)
                self._recovered()
            except MasterUnreachable as error:
                self._troubled(str(error))
                with self._changed:
                    self._stale |= stale
            except Exception:  # a bug; without this thread nothing would ever be registered again
                logger.exception("registering with the master failed")
            if closed:
                return

    def _reconcile(self, wanted: Dict[Entry, str], stale: Set[Entry]) -> None:
        if not self._closed and (not stale or self.trouble) and not self._master_knows_us():
            logger.warning("the master at %s has forgotten this node; registering everything again", self._master.uri)
            self._known.clear()
            self.generation += 1
        for entry in [each for each in self._known if each not in wanted]:
            self._unregister(entry, self._known[entry])
        for entry, type_or_uri in wanted.items():
            if self._closed:
                return  # rospy is about to unregister everything: nothing may be registered behind its back
            if entry in stale or self._known.get(entry) != type_or_uri:
                self._register(entry, type_or_uri)

    def _master_knows_us(self) -> bool:
        try:
            return bool(self._master.call("lookupNode", self._master.caller_id) == self.rospy_registration.uri)
        except MasterError:
            return False

    def _register(self, entry: Entry, type_or_uri: str) -> None:
        uri = self.rospy_registration.uri
        try:
            if entry.kind == Registration.PUB:
                peers = self._master.call("registerPublisher", entry.name, type_or_uri, uri)
            elif entry.kind == Registration.SUB:
                peers = self._master.call("registerSubscriber", entry.name, type_or_uri, uri)
                self.rospy_registration.publisher_update(entry.name, peers)
            else:
                self._master.call("registerService", entry.name, type_or_uri, uri)
                peers = []
        except MasterError as error:
            logger.error("the master refuses %s %s: %s", entry.kind, entry.name, error)
            self._settle(entry, error)
        else:
            self._settle(entry, list(peers))
        self._known[entry] = type_or_uri

    def _unregister(self, entry: Entry, type_or_uri: str) -> None:
        method = {
            Registration.PUB: "unregisterPublisher",
            Registration.SUB: "unregisterSubscriber",
            Registration.SRV: "unregisterService",
        }[entry.kind]
        uri = type_or_uri if entry.kind == Registration.SRV else self.rospy_registration.uri
        try:
            self._master.call(method, entry.name, uri)
        except MasterError as error:
            logger.warning("the master refuses to forget %s %s: %s", entry.kind, entry.name, error)
        del self._known[entry]

    def _settle(self, entry: Entry, outcome: Union[List[str], MasterError]) -> None:
        with self._changed:
            if entry in self._stale:
                return  # removed or added anew meanwhile
            if not isinstance(outcome, MasterError):
                self._peers[entry] = outcome
            waiting = self._waiting.pop(entry, [])
        for future in waiting:
            if not future.set_running_or_notify_cancel():
                continue
            if isinstance(outcome, MasterError):
                future.set_exception(outcome)
            else:
                future.set_result(outcome)

    def _troubled(self, reason: str) -> None:
        if self.trouble is None:
            logger.error("%s; clients stay connected, and everything is registered when it is back", reason)
        self.trouble = reason

    def _recovered(self) -> None:
        if self.trouble is not None:
            logger.info("the master at %s answers again", self._master.uri)
        self.trouble = None
