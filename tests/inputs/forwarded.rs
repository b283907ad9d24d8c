//! The header in which web servers tell whom they forward; anybody can write it.

use std::net::IpAddr;

use actix_web::http::header::HeaderValue;
use actix_web::test::TestRequest;
use webots_fleet::shared::http::{Peer, TrustedProxies};

#[test]
fn only_a_trusted_proxy_is_believed_and_only_addresses_are() {
    let trusted: TrustedProxies = serde_json::from_str(r#"["127.0.0.0/8", "10.0.0.0/8"]"#).unwrap();
    let stranger: IpAddr = "203.0.113.9".parse().unwrap();
    let proxy: IpAddr = "127.0.0.1".parse().unwrap();
    super::try_many(include_str!("seeds/forwarded.txt"), |input| {
        let Ok(value) = HeaderValue::from_bytes(input) else {
            return;
        };
        let from = |address: IpAddr| {
            let request = TestRequest::default().peer_addr((address, 4000).into());
            trusted.peer(&request.insert_header(("x-forwarded-for", value.clone())).to_http_request())
        };
        assert_eq!(from(stranger), Peer::Client(stranger));
        match from(proxy) {
            Peer::Client(address) | Peer::Proxy(address) if address == proxy => {}
            Peer::Client(address) => assert!(is_named(input, address), "{address} from {value:?}"),
            other => panic!("{other:?} from {value:?}"),
        }
    });
}

/// Whether a header names an address, in whatever spelling.
fn is_named(header: &[u8], address: IpAddr) -> bool {
    let text = String::from_utf8_lossy(header);
    let pieces = || text.split([',', ';', '=', ' ', '\t', '"', '[', ']', '%']);
    let ports = pieces().filter_map(|piece| piece.rsplit_once(':')).map(|(host, _)| host);
    pieces().chain(ports).filter_map(|piece| piece.parse::<IpAddr>().ok()).any(|one| one.to_canonical() == address)
}
