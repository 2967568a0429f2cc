"""Decide what runs: group granules into scenes, and make the plan of each scene.

A plan is pure data: the graph of the steps of a scene. It follows from the campaign and the
headers, before any signal is read, and states a reason for every step that runs or is left out.
Each step decides for itself (`lidarops.steps`, ``lidarops/products/KIND/steps.py``).
"""
