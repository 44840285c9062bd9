"""Networks: functions of x without physics."""
