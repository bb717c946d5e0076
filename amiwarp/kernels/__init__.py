"""Warp structs, device functions and kernels. Private: users call the modules of the rooms above.

Warp prints its banner, and a line for each module that it loads, on stdout, among the results. Importing this package
raises Warp's log level so that only warnings and errors remain. A level other than Warp's default is the user's and
stays. The environment variable ``AMIWARP_VERBOSE=1`` keeps the lines.
"""

import os

import warp as wp

if wp.config.log_level == wp.LOG_INFO and os.environ.get("AMIWARP_VERBOSE", "0") in ("", "0"):
    wp.config.log_level = wp.LOG_WARNING
