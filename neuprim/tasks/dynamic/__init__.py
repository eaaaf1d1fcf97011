"""Dynamic volumes: smoke and fire from OpenVDB sequences."""
