# SPDX-License-Identifier: BSD-3-Clause
"""Which text XML can hold, and so a call of the master.

The master answers anything else with an HTTP error, as if it were broken.
"""

from __future__ import annotations

import re

_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def is_xml_text(text: str) -> bool:
    """Whether all of `text` is in the characters of XML 1.0 (section 2.2): no NUL, no half surrogate pair."""
    return _NOT_XML.search(text) is None
