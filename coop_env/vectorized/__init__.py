"""Many environments moved by one kernel call, in Gymnasium's form and in SB3's."""
