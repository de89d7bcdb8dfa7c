# SPDX-License-Identifier: BSD-3-Clause
"""Parameters as JSON text, within the globs, on the parameter server's own logic."""

from __future__ import annotations

import datetime
import json
import math
from typing import Any, Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosapi.params import Params, from_json, to_json
from rosbridge_library.access import Access
from rosbridge_library.parameter_values import MAX_DEPTH, ParameterError

Call = Callable[..., Any]


@pytest.fixture
def params(master_call: Call) -> Params:
    return Params(master_call, Access())


XML_TEXT = st.text(st.characters(blacklist_categories=("Cs", "Cc"), blacklist_characters="\ufffe\uffff"))
VALUES = st.recursive(
    st.booleans() | st.integers(-(2**31), 2**31 - 1) | st.floats(allow_nan=False, allow_infinity=False) | XML_TEXT,
    lambda children: st.lists(children, max_size=4) | st.dictionaries(XML_TEXT, children, max_size=4),
    max_leaves=12,
)


class TestJson:
    @given(VALUES)
    def test_what_the_server_can_hold_passes_unchanged(self, value: Any) -> None:
        assert json.loads(to_json(from_json(json.dumps(value)))) == value

    @given(st.text())
    def test_any_text_is_a_value_or_an_error(self, text: str) -> None:
        try:
            value = from_json(text)
        except ParameterError:
            return
        if "NaN" not in text and "Infinity" not in text:  # which are read, but written as null
            assert from_json(to_json(value)) == value

    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (None, "null"),
            (math.nan, "null"),
            (-math.inf, "null"),
            ([1.5, math.nan], "[1.5, null]"),
            (b"\x00\xff", '"AP8="'),
            (datetime.datetime(2020, 2, 29, 12, 30, 5), '"2020-02-29T12:30:05"'),
            ({1: {None: True}}, '{"1": {"None": true}}'),
            (2**40, "1099511627776"),
            (2**64, "1.8446744073709552e+19"),
            (10**400, "null"),
            ((1, 2), "[1, 2]"),
            ("é\n", '"\\u00e9\\n"'),
        ],
    )
    def test_what_others_have_set_always_becomes_json(self, value: Any, text: str) -> None:
        assert to_json(value) == text

    @pytest.mark.parametrize(
        ("text", "reason"),
        [
            ("hello", 'JSON.*"hello"'),
            ("", "JSON"),
            ("{'a': 1}", "JSON"),
            ("[1,", "JSON"),
            ("null", "null$"),
            ('{"a": [1, null]}', r"null at 'a\[1\]'"),
            ("2147483648", "32 bits only, not 2147483648"),
            ('{"a": {"b": -2147483649}}', "32 bits only, not -2147483649 at 'a.b'"),
            ("1" + 1000 * "0", "32 bits only"),
            ("1" + 10000 * "0", "JSON|32 bits only"),
            ('"\\u0000"', "control characters"),
            ('"\\ud800"', "surrogate"),
            ('{"a\\u0001": 1}', "control characters"),
            (200 * "[" + 200 * "]", "deeper"),
            (200 * '{"a":' + "1" + 200 * "}", "deeper"),
            (1_000_000 * "[", "deeper|JSON"),
        ],
    )
    def test_what_the_server_cannot_hold_is_refused_with_the_reason(self, text: str, reason: str) -> None:
        with pytest.raises(ParameterError, match=reason):
            from_json(text)

    def test_the_deepest_value_allowed_passes(self) -> None:
        text = MAX_DEPTH * "[" + MAX_DEPTH * "]"
        assert to_json(from_json(text)) == text

    def test_python_clients_may_write_infinity(self) -> None:
        assert from_json("[Infinity]") == [math.inf]


class TestParams:
    def test_set_get_has_delete(self, params: Params) -> None:
        assert not params.has("/robot/speed")
        params.set("/robot/speed", "1.5")
        assert params.has("/robot/speed")
        assert params.get("/robot/speed") == "1.5"
        assert params.get("/robot") == '{"speed": 1.5}'
        params.delete("/robot/speed")
        assert not params.has("/robot/speed")
        params.delete("/robot/speed")  # twice is no error

    def test_names_are_global(self, params: Params) -> None:
        params.set("robot//speed/", '"fast"')
        assert params.names() == ["/robot/speed"]
        assert params.get("robot/speed") == '"fast"'
        assert params.has("robot")
        params.delete("robot/speed")
        assert params.names() == []

    @pytest.mark.parametrize(
        ("default", "answer"),
        [
            ("", "null"),
            ("null", "null"),
            ("7", "7"),
            ('"text"', '"text"'),
            ('{"a":[1,2.0]}', '{"a": [1, 2.0]}'),
            ("NaN", "null"),
            ("plain text", '"plain text"'),
            ("{broken", '"{broken"'),
            (100_000 * "[", json.dumps(100_000 * "[")),
        ],
    )
    def test_default_is_json_or_else_a_string(self, params: Params, default: str, answer: str) -> None:
        assert params.get("/missing", default) == answer
        params.set("/there", "false")
        assert params.get("/there", default) == "false"

    def test_namespaces_replace_and_nest(self, params: Params) -> None:
        params.set("/robot", '{"a": 1, "deep": {"b": "x"}}')
        assert params.names() == ["/robot/a", "/robot/deep/b"]
        params.set("/robot/deep", "[]")
        assert json.loads(params.get("/")) == {"robot": {"a": 1, "deep": []}}
        params.set("/empty", "{}")
        assert params.get("/empty") == "{}"

    def test_search_goes_up_from_the_namespace_of_rosapi(self, params: Params) -> None:
        params.set("/robot_description", '"<robot/>"')
        assert params.search("robot_description") == "/robot_description"
        assert params.search("/robot_description") == "/robot_description"
        params.set("/rosapi/robot_description", '"mine"')
        assert params.search("robot_description") == "/rosapi/robot_description"

    @pytest.mark.parametrize("name", ["", "/", "~x", "missing", "/missing", "a\x00b", "\ud800"])
    def test_search_without_a_match_is_empty(self, params: Params, name: str) -> None:
        assert params.search(name) == ""

    @pytest.mark.parametrize("name", ["", "a\x00b", "\ud800"])
    def test_what_cannot_be_a_name_is_not_there(self, params: Params, name: str) -> None:
        assert not params.has(name)
        assert params.get(name, "5") == "5"
        with pytest.raises(ParameterError, match="name"):
            params.set(name, "1")
        with pytest.raises(ParameterError, match="name"):
            params.delete(name)

    def test_the_root_is_neither_a_number_nor_deleted(self, params: Params) -> None:
        params.set("/a", "1")
        with pytest.raises(ParameterError, match="refuses"):
            params.set("/", "1")
        with pytest.raises(ParameterError, match="refuses"):
            params.delete("/")
        assert params.names() == ["/a"]


class TestGlobs:
    @pytest.fixture
    def limited(self, master_call: Call) -> Params:
        everything = Params(master_call, Access())
        everything.set("/robot", '{"speed": 1, "secret": {"key": "k"}, "secret_speed": 2}')
        everything.set("/other", "3")
        return Params(master_call, Access.from_parameters(params_glob="[/robot, /robot/speed, '/new*']"))

    def test_what_is_closed_looks_missing(self, limited: Params) -> None:
        assert limited.names() == ["/robot/speed"]
        assert limited.get("/robot/speed") == "1"
        assert limited.get("/other", '"default"') == '"default"'
        assert limited.get("/robot/secret/key") == "null"
        assert limited.get("/") == "null"
        assert not limited.has("/other")
        assert not limited.has("/robot/secret")
        assert limited.search("other") == ""
        assert limited.search("robot/speed") == "/robot/speed"

    def test_reading_a_namespace_leaves_out_what_is_closed(self, limited: Params) -> None:
        assert limited.get("/robot") == '{"speed": 1}'

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("/other", "4"),
            ("/", '{"robot": {"speed": 9}}'),
            ("/robot/secret", '{"key": "mine"}'),
            ("/robot/secret/key", '"mine"'),
            ("/robot", "5"),  # would replace the secret
            ("/robot", '{"speed": 2}'),
            ("/robot", '{"speed": 2, "secret": 1}'),
            ("/robot/secret_speed/x", "1"),
            ("/newer", '{"/../../other": 1}'),
        ],
    )
    def test_nothing_that_is_closed_is_changed(self, limited: Params, master_call: Call, name: str, value: str) -> None:
        before = master_call("getParam", "/")
        if name != "/newer":
            with pytest.raises(ParameterError, match="params_glob"):
                limited.set(name, value)
        else:
            limited.set(name, value)  # a strange key, but below /newer
            limited.delete(name)
        assert master_call("getParam", "/") == before

    def test_a_value_above_is_not_turned_into_a_namespace(self, master_call: Call) -> None:
        Params(master_call, Access()).set("/robot", "1")
        below = Params(master_call, Access.from_parameters(params_glob="[/robot/*]"))
        with pytest.raises(ParameterError, match="'/robot'"):
            below.set("/robot/speed", "1")
        assert master_call("getParam", "/robot") == 1

    @pytest.mark.parametrize("name", ["/other", "/robot", "/robot/secret", "/", "/robot/secret/key"])
    def test_nothing_that_is_closed_is_deleted(self, limited: Params, master_call: Call, name: str) -> None:
        before = master_call("getParam", "/")
        with pytest.raises(ParameterError, match="params_glob"):
            limited.delete(name)
        assert master_call("getParam", "/") == before

    def test_what_is_open_can_be_set_and_deleted(self, limited: Params) -> None:
        limited.set("/robot/speed", "2")
        assert limited.get("/robot/speed") == "2"
        limited.delete("/robot/speed")
        assert not limited.has("/robot/speed")
        limited.set("/new", '{"a": 1}')
        assert limited.get("/new") == '{"a": 1}'
