"""The verdict on a run: metrics and the papers' guarantees, computed from the trace alone.

Motion is reckoned here anew, and claims are judged by it: what the world or an algorithm got wrong is
found here.

    ledger = ledger_of(ground, starts, scenario)  metrics, and whether the trace is possible at all
    monitors = monitors_of(scenario, ledger)      the claims of the algorithm's paper
    for observe in observers(ledger, monitors):   each is to be called with every event, in order
        ...
    result = judge(scenario, ledger, monitors, status=..., engine=..., trace_sha256=...)
"""
