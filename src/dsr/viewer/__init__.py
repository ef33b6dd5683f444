"""The page of ``dsr view``: results of `dsr upsample` as surfaces to turn and to light, in one HTML file."""
