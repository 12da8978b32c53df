"""The sealing environment: one batched core, its faces, action adapters."""
