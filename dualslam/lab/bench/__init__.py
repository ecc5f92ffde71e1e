"""Benches: sequences x variants x conditions x trials, from one YAML file to the tables of the paper.

`BenchSpec` says what to run, `plan_trials` makes each trial out of it, `run_bench` runs those that are not done yet
with a function that it is handed, and `tables` counts. Nothing here knows how a system is built.
"""
