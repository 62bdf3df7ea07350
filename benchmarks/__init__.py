# SPDX-License-Identifier: Apache-2.0
"""Programs that print the figures of docs/performance.md: `python -m benchmarks` or `make bench`.

    __main__   options, one child process a case, the report
    case       what a case is and what is measured of it
    one_core   one pinned core, one thread in every library
    measure    the child: bytes to bytes through the pipeline, its rival, the yardstick
    guard      ratios that hold on any machine, for the tests
    surface    a closed bumpy surface given by a formula, and even samples of it
    rival      upsampling without learning, from library parts
    yardstick  how fast this core multiplies matrices
    roofline   how much of that the network asks for
    machine    what the figures were measured on
    report     Markdown

This process stays free of numpy and torch: the threads of their libraries are counted when they
are loaded, and only a fresh process has a peak memory of its own.
"""
