from scripts.reports.run import report

report("verdict")
