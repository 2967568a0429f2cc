"""Raw counts to signals: dead time, dark signal, lag, gluing, averaging."""
