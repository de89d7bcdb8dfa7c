# SPDX-License-Identifier: BSD-3-Clause
"""Parts that other packages import by their old names: type loading, message conversion and the exceptions."""
