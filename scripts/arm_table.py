from scripts.reports.run import report

report("arm", "table")
