"""Everything that renders: ray casters, SimGeo's scenes, random scenes to train on."""
