"""Figures of products, which the report and the site share.

- Data reduction: ``series_data.py`` and ``raster.py`` hold what figures show as plain arrays;
  ``time_axis.py`` finds gaps; ``wording.py`` formats numbers and names.
- Panels: ``panels.py`` states what a figure shows, as values; ``series_panels.py``,
  ``image_panels.py`` and ``profile_panels.py`` make them, and ``site/quality.py``.
- Drawing: ``browser.py`` puts panels into a page as data, which ``figures.js`` draws;
  ``stills.py`` makes files. A figure takes at most 0.1 s of CPU time and 300 kB of a page.
- Kinds: ``kind_figures.py`` is what a kind of product states about its figures in its module
  ``figures``, and draws products of a kind that states nothing.
"""
