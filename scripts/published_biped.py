from scripts.reports.run import report

report("locomotion", "published")
