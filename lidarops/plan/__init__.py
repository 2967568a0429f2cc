"""Decide what runs: group granules into scenes, and make the plan of each scene.

A plan is pure data. It follows from the campaign and the headers, before any signal is read, and
states a reason for everything that runs or is left out. Each stage of the pipe (`lidarops.scene`)
and each kind (``lidarops/products/KIND/retrieval.py``) decides for itself.
"""
