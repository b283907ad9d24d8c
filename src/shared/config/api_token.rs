//! The key `apiTokens` of both servers: what programs sign in with.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::loading::require;
use super::secret::Secret;

/// A token of a program.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ApiToken {
    /// The program's name, for the log.
    pub name: String,
    /// What it sends: long and random, because guesses of it are not limited.
    pub token: Secret,
    /// What it may do.
    pub may: Permission,
}

/// What an administrator or a program may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Permission {
    /// See everything.
    Read,
    /// Also change something: stop simulations, announce, drain.
    Act,
}

/// Fewest letters of a token.
const MIN_LENGTH: usize = 32;
/// Fewest different letters of a token. A random one of 32 hexadecimal digits has fewer once in 100,000 times.
const MIN_DIFFERENT: usize = 8;
/// Longest name, in letters.
const MAX_NAME: usize = 60;

/// Checks the key `apiTokens`.
///
/// # Errors
/// When a token can be guessed or sent by no program, or two have the same name.
pub fn check_api_tokens(tokens: &[ApiToken]) -> Result<(), String> {
    let mut names = HashSet::new();
    for ApiToken { name, token, .. } in tokens {
        let is_name = (1..=MAX_NAME).contains(&name.chars().count()) && !name.chars().any(char::is_control);
        require(is_name, "apiTokens", || {
            format!("{name:?} is no name of 1 to {MAX_NAME} letters")
        })?;
        require(names.insert(name), "apiTokens", || {
            format!("two tokens have the name {name:?}")
        })?;
        let token = token.reveal();
        let different: HashSet<char> = token.chars().collect();
        let is_random = token.len() >= MIN_LENGTH && different.len() >= MIN_DIFFERENT;
        require(
            is_random && token.chars().all(|letter| letter.is_ascii_graphic()),
            "apiTokens",
            || {
                format!(
                    "that of {name:?} is no random text of at least {MIN_LENGTH} ASCII letters without spaces; \
                     `openssl rand -hex 32` prints a good one"
                )
            },
        )?;
    }
    Ok(())
}
