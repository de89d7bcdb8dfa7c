# SPDX-License-Identifier: BSD-3-Clause
"""fetchAsset: files that messages and robot models name, such as meshes.

What may be fetched is decided by regular expressions for the whole URI. Beyond them a path has no `..` in it, and what
it leads to, links followed, is a file of that package; a `file://` URI must be allowed for where its links lead, too.
"""

from __future__ import annotations

import asyncio
import os
import re
import stat
import sys
import threading
from pathlib import Path
from typing import Iterator, Optional
from urllib.parse import unquote

import rospkg

from rosbridge_library.capability import Capability, Operation
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.fields import number, text
from rosbridge_library.foxglove.options import Options, matches
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.internal.exceptions import RosbridgeError

FETCH_TIMEOUT_S = 30.0
ENOUGH_WAITS_BYTES = 1024 * 1024
"""While more waits for a client, its next asset is not read."""
LOOK_AGAIN_S = 0.02

_PACKAGE_NAME = re.compile(r"[A-Za-z0-9][-\w.]*\Z")


class AssetError(RosbridgeError):
    """Why an asset can't be had."""


class Assets:
    """Finds and reads assets; its methods block, and may be called from several threads."""

    def __init__(self, options: Options) -> None:
        self._allowed = options.asset_uri_allowlist
        self._max_bytes = options.max_client_bytes
        self._packages = rospkg.RosPack()
        self._lock = threading.Lock()  # RosPack fills a cache

    def read(self, uri: str) -> bytes:
        """The content of the file that `uri` names. Raises AssetError."""
        if not matches(self._allowed, uri):
            raise AssetError(f"the server does not let clients fetch {uri}")
        scheme, _, rest = uri.partition("://")
        path = unquote(rest)
        if "\0" in path or ".." in path.split("/"):
            raise AssetError(f"a path with '..' is not served: {uri}")
        if scheme == "package":
            return self._read_file(self._in_package(uri, path), uri)
        if scheme == "file":
            return self._read_file(self._local(uri, path), uri)
        raise AssetError(f"only package:// and file:// URIs can be fetched, not {uri}")

    def _in_package(self, uri: str, path: str) -> Path:
        package, _, inner = path.partition("/")
        directory = self._package(package)
        if directory is None:
            raise AssetError(f"there is no package {package}: {uri}")
        root = directory.resolve()
        file = _resolved(root / inner.lstrip("/"), uri)
        if root not in file.parents:
            raise AssetError(f"it is a link out of the package {package}: {uri}")
        return file

    def _package(self, name: str) -> Optional[Path]:
        if not _PACKAGE_NAME.match(name):
            return None
        with self._lock:
            try:
                return Path(self._packages.get_path(name))
            except rospkg.ResourceNotFound:
                # It may have been installed since, or without its manifest.
                self._packages = rospkg.RosPack()
        return next((share / name for share in _share_folders() if (share / name).is_dir()), None)

    def _local(self, uri: str, path: str) -> Path:
        if not path.startswith("/"):
            raise AssetError(f"a file:// URI needs an absolute path: {uri}")
        file = _resolved(Path(path), uri)
        if str(file) != os.path.normpath(path) and not matches(self._allowed, f"file://{file}"):
            raise AssetError(f"it is a link to what the server does not let clients fetch: {uri}")
        return file

    def _read_file(self, file: Path, uri: str) -> bytes:
        try:
            # Not blocking, since it may be a pipe; no link, since all of them have been followed.
            descriptor = os.open(str(file), os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
            with open(descriptor, "rb") as opened:
                status = os.fstat(descriptor)
                if not stat.S_ISREG(status.st_mode):
                    raise AssetError(f"it is not a file: {uri}")
                if status.st_size > self._max_bytes:
                    raise AssetError(f"its {status.st_size} bytes are more than {self._max_bytes}: {uri}")
                content = opened.read(self._max_bytes + 1)
        except OSError as error:
            raise AssetError(f"{error.strerror}: {uri}") from error
        if len(content) > self._max_bytes:
            raise AssetError(f"it is larger than {self._max_bytes} bytes: {uri}")
        return content


def _resolved(path: Path, uri: str) -> Path:
    try:
        return path.resolve(strict=True)
    except (OSError, RuntimeError) as error:  # RuntimeError: links that go in a circle
        raise AssetError(f"{getattr(error, 'strerror', None) or error}: {uri}") from error


def _share_folders() -> Iterator[Path]:
    """Where packages are installed: distributions ship some without the manifest that makes them known to rospkg."""
    for entry in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep):
        if entry:
            yield Path(entry)
    prefixes = os.environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep)
    for prefix in (*prefixes, os.environ.get("ROS_ROOT", "").partition("/share/")[0], sys.prefix, "/usr"):
        if prefix:
            yield Path(prefix) / "share"


class FetchAsset(Capability):
    """Sends files to one client, one after the other, beside all else."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        self._turn = asyncio.Lock()
        protocol.register_operation("fetchAsset", self.fetch)

    def fetch(self, message: Operation) -> None:
        """Begin to fetch. It gets exactly one answer."""
        request_id = number(message, "requestId")
        self.protocol.spawn(self._fetch(request_id, message), message)

    async def _fetch(self, request_id: int, message: Operation) -> None:
        try:
            uri = text(message, "uri")
            async with self._turn:
                # A robot has a hundred megabytes of meshes; what a slow client has not taken yet must not pile up.
                while self.protocol.outbox.waiting_bytes > ENOUGH_WAITS_BYTES:  # noqa: ASYNC110  # nobody tells
                    await asyncio.sleep(LOOK_AGAIN_S)
                assets = self.protocol.server.assets
                content = await self.protocol.node.call(assets.read, uri, timeout=FETCH_TIMEOUT_S)
                self.protocol.send_payload(messages.asset(request_id, content))
        except RosbridgeError as error:
            self.protocol.send_payload(messages.asset_error(request_id, str(error)))
        except Exception as error:  # a bug here must not leave the client waiting; it is reported whole by the caller
            reason = f"internal error ({type(error).__name__})"
            self.protocol.send_payload(messages.asset_error(request_id, reason))
            raise
