"""Benches: sequences x variants x conditions x trials, from one YAML file to the tables of the paper.

`BenchSpec` says what to run, and `plan_trials` makes the trials of it. `run_bench` runs those that are not done yet
with a given function, and `tables` counts. Nothing here knows how a system is built.
"""
