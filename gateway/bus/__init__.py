"""The bus interface of one car: service, publications, requests, and the sync of e-stops with other gateways."""
