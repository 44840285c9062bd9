"""One program over several devices and hosts: processes that know each other, and batches split over their devices."""
