"""Data reduction and drawing that kinds of product share, for the report and the site.

Three layers of modules:

- Data reduction: ``series_data.py`` and ``raster.py`` hold what figures show as plain arrays;
  ``time_axis.py`` lays out time axes; ``reading.py`` and ``report_sources.py`` read products in
  parallel; ``wording.py`` formats numbers and names. The report and the site both use them.
- Drawing: ``svg.py`` and ``svg_*.py`` for the site, without matplotlib; ``panels.py``,
  ``product_figures.py`` and ``charts.py`` with matplotlib for reports.
- Kinds: ``kind_figures.py`` is what a kind of product states about its figures in its modules
  ``figures`` and ``report_figures``; ``kind_images.py`` is the image that several have;
  ``any_kind.py`` and ``any_kind_report.py`` draw products of a kind that states nothing.
"""
