"""The verdict on a run: metrics and the papers' guarantees, computed from the trace alone.

Nothing here shares code with the world or with an algorithm; what they got wrong is found here.

    ledger = Ledger(graph, starts, scenario)      metrics, and whether the trace is possible at all
    monitors = monitors_of(scenario, ledger)      the claims of the algorithm's paper
    for observe in observers(ledger, monitors):   each is to be called with every event, in order
        ...
    result = judge(scenario, ledger, monitors, status=..., engine=..., trace_sha256=...)
"""
