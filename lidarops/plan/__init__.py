"""Decide what runs: group granules into scenes, and make the plan of each scene.

A plan is pure data. It follows from the campaign and the headers, before any signal is read, and
states a reason for every step that runs or is left out. `scene_plan` decides for a single
instrument, `network_plan` for a network, with rules from `signal_rules` and `scan_rules`. `rules`
defines what a rule is; `rule_table` lists all rules. `preview` leaves out further sections in the
worker.
"""
