"""The command behind ``dsr app``: a local web page that runs ``dsr upsample`` on uploaded files."""
