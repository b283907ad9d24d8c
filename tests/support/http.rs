//! HTTP requests with a deadline.

use actix_web::web::Bytes;
use awc::http::StatusCode;
use awc::http::header::HeaderMap;

use super::SOON;

/// A complete response.
#[derive(Debug)]
pub struct Answer {
    pub status: StatusCode,
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl Answer {
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.get(name).and_then(|value| value.to_str().ok())
    }
}

/// The password of administrators in tests.
pub const PASSWORD: &str = "open sesame";

/// Gets a page with the administrator's password.
pub async fn get_as_administrator(url: &str) -> Answer {
    get_with_password(url, PASSWORD).await
}

/// Gets a page with this password.
pub async fn get_with_password(url: &str, password: &str) -> Answer {
    read(client().get(url).basic_auth("admin", password)).await.unwrap()
}

/// Posts a body, with a password if one is given. Returns the status.
pub async fn post(url: &str, password: Option<&str>, body: &str) -> u16 {
    let request = client().post(url);
    let request = match password {
        Some(password) => request.basic_auth("admin", password),
        None => request,
    };
    request.send_body(body.to_owned()).await.unwrap().status().as_u16()
}

/// Gets a page.
pub async fn get(url: &str) -> Answer {
    try_get(url).await.unwrap_or_else(|error| panic!("{url}: {error}"))
}

/// Gets a page from a server that may be down.
pub async fn try_get(url: &str) -> Result<Answer, String> {
    read(client().get(url)).await
}

fn client() -> awc::Client {
    awc::Client::builder().timeout(SOON).disable_redirects().finish()
}

async fn read(request: awc::ClientRequest) -> Result<Answer, String> {
    let mut answer = request.send().await.map_err(|error| error.to_string())?;
    let body = answer.body().limit(64 << 20).await.map_err(|error| error.to_string())?;
    Ok(Answer {
        status: answer.status(),
        headers: answer.headers().clone(),
        body,
    })
}
