"""Networks: functions of x that know no physics."""
