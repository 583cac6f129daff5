"""A hub with certificates and rules: who may connect, and who may use which keys.

`access_rules` has the rules (pure). `certificate_authority` makes the certificates, `hub_store` stores them and the
list of identities. `invitation` lets another computer join, which calls `join`.
"""
