"""Figures of products, which the report and the site share.

Three layers of modules:

- Data reduction: ``series_data.py`` and ``raster.py`` hold what figures show as plain arrays;
  ``time_axis.py`` lays out time axes; ``wording.py`` formats numbers and names.
- Panels: ``panels.py`` states what a figure shows, as values; ``series_panels.py``,
  ``image_panels.py`` and ``quality_panel.py`` make them; ``svg.py`` and ``pixels.py`` draw them, in
  the style of ``figure.css``. A figure takes at most 0.1 s of CPU time and 300 kB.
- Kinds: ``kind_figures.py`` is what a kind of product states about its figures in its module
  ``figures``; ``any_kind.py`` draws products of a kind that states nothing.
"""
