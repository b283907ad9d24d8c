//! A struct of keys, each with its default value.

/// Defines a struct and its `Default`: each field is followed by `= DEFAULT`.
macro_rules! keys {
    ($(#[$of_struct:meta])* pub struct $name:ident { $($(#[$of_key:meta])* pub $key:ident: $kind:ty = $default:expr,)* }) => {
        $(#[$of_struct])*
        pub struct $name {
            $($(#[$of_key])* pub $key: $kind,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($key: $default,)* }
            }
        }
    };
}

pub(crate) use keys;
