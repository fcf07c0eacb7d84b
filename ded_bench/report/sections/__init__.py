"""The sections of a report: each a function of what was read and drawn, and a name in `report.SECTIONS`."""
