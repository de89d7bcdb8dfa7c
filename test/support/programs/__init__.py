# SPDX-License-Identifier: BSD-3-Clause
"""Programs that run as nodes in tests; started by support.node, never imported by a test."""
