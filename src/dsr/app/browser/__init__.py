"""The command behind ``dsr app``: a page of this machine's own server, on which ``dsr upsample`` is used."""
