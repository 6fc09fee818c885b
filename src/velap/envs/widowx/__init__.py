"""The two tasks of the WidowX 200 arm (Sec. 5.2, App. E.1), in simulation."""
