# SPDX-License-Identifier: BSD-3-Clause
"""The Foxglove WebSocket protocol, `foxglove.websocket.v1`, beside rosbridge on the same shared ROS side.

`messages` is the protocol's text and binary messages, and pure. Each other module is one concern of it: channels,
publishing, services, parameters, connection graph, assets, time. `server` is what all clients share, `protocol` one
client.
"""
