# SPDX-License-Identifier: BSD-3-Clause
"""Globs: how they are written, and what they match."""

from __future__ import annotations

from typing import List, Optional

import pytest

from rosbridge_library.access import Access, matches, parse_globs


@pytest.mark.parametrize(
    ("text", "globs"),
    [
        (None, None),
        ("", None),
        ("  ", None),
        ("[]", None),
        ("[ ]", None),
        ("['']", None),
        ("[,]", None),
        ("[*]", ["*"]),
        ("*", ["*"]),
        ("[/camera/*, '/tf']", ["/camera/*", "/tf"]),
        ('["/a", "/b"]', ["/a", "/b"]),
        ("/a, /b", ["/a", "/b"]),
        ("  [ /a ]  ", ["/a"]),
    ],
)
def test_how_globs_are_written(text: Optional[str], globs: Optional[List[str]]) -> None:
    assert parse_globs(text) == globs


@pytest.mark.parametrize(
    ("glob", "name", "expected"),
    [
        ("*", "/anything/at/all", True),
        ("/tf", "/tf", True),
        ("/tf", "tf", True),
        ("tf", "/tf", True),
        ("/tf", "/tf/", True),
        ("/tf", "//tf", True),
        ("/tf", "/tf_static", False),
        ("/tf", "/x/tf", False),
        ("/TF", "/tf", False),
        ("/camera/*", "/camera/left/image", True),
        ("/camera/*", "/camera", False),
        ("/camera*", "/camera", True),
        ("/camera/?", "/camera/a", True),
        ("/camera/?", "/camera/ab", False),
        ("/camera/[ab]", "/camera/a", True),
        ("/camera/[ab]", "/camera/c", False),
        ("*/image", "/camera/image", True),
        ("*/image", "/camera/images", False),
        ("/a.b", "/axb", False),
        ("/tf", "/tf\n", False),
    ],
)
def test_what_globs_match(glob: str, name: str, expected: bool) -> None:
    assert matches([glob], name) is expected


def test_any_of_several_globs_is_enough() -> None:
    assert matches(["/a", "/b/*"], "/b/c")
    assert not matches(["/a", "/b/*"], "/c")


def test_no_globs_allow_everything() -> None:
    access = Access()
    for may in (access.may_publish, access.may_subscribe, access.may_call, access.may_provide, access.may_use_param):
        assert may("/anything")


def test_each_kind_of_name_has_its_own_globs() -> None:
    access = Access.from_parameters("[/topic]", "[/service]", "[/param]")
    for may, name in (
        (access.may_publish, "/topic"),
        (access.may_subscribe, "/topic"),
        (access.may_call, "/service"),
        (access.may_provide, "/service"),
        (access.may_use_param, "/param"),
    ):
        assert may(name)
        assert not any(may(other) for other in ("/topic", "/service", "/param", "/x") if other != name)


def test_rosapi_may_be_called_but_not_provided() -> None:
    access = Access.from_parameters(services_glob="[/only/this]")
    assert access.may_call("/rosapi/topics")
    assert access.may_call("rosapi/topics")
    assert not access.may_call("/rosapi")
    assert not access.may_call("/rosapi_other/topics")
    assert not access.may_call("/x/rosapi/topics")
    assert not access.may_provide("/rosapi/topics")


def test_a_star_among_globs_allows_everything() -> None:
    assert Access.from_parameters("[/a, *]").may_publish("/b")
