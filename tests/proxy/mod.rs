//! The fleet behind real web servers: Debian's apache2 and nginx, started here on free ports of the loopback, with our
//! rules (`deploy/`) and with those of the original documents.

/// Makes two tests of a function: with our rules for Apache, and with ours for nginx.
macro_rules! through_both {
    ($test:ident) => {
        mod $test {
            #[actix_rt::test]
            async fn apache() {
                super::$test(crate::proxy::rules::Rules::Apache).await;
            }

            #[actix_rt::test]
            async fn nginx() {
                super::$test(crate::proxy::rules::Rules::Nginx).await;
            }
        }
    };
}

mod browser;
mod fleet;
mod rules;
mod web_server;

mod connections;
mod exposure;
mod one_door;
mod relayed;
mod users;
mod whole_way;
