# SPDX-License-Identifier: BSD-3-Clause
"""What the suites share: private ROS masters, real server and node processes, and a test client.

Nothing here stands in for a part of the product: masters, servers and nodes are processes of their own,
started from the devel space and ended by their process group. Every wait is a condition with a deadline.
"""
