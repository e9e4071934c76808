"""TD3, SAC and TD7, and the released code's variants of them."""
