// Receive positions of ipsys on an ESP32 (docs/streams.md). Needs the library ArduinoJson 7.
// Old, repeated, foreign and forged datagrams are dropped. The robot stops 0.5 s after the last position.
#include <ArduinoJson.h>
#include <WiFi.h>
#include <WiFiUdp.h>
#include <mbedtls/md.h>

const char *NETWORK = "lab", *PASSWORD = "password", *ROBOT = "ada";
const char *KEY = "";  // the content of the key file; empty without --key
const uint16_t PORT = 9870;
const unsigned long STOP_MS = 500;

WiFiUDP udp;
uint64_t session = 0;
uint32_t sequence = 0;
unsigned long last_ms = 0;

// Compare the signature after the line break with that of the object before it.
bool is_signed(const char *body, size_t length, const char *code) {
  if (!*KEY) return true;
  unsigned char mac[32];
  char expected[65];
  mbedtls_md_hmac(mbedtls_md_info_from_type(MBEDTLS_MD_SHA256), (const unsigned char *)KEY, strlen(KEY),
                  (const unsigned char *)body, length, mac);
  for (int n = 0; n < 32; n++) sprintf(expected + 2 * n, "%02x", mac[n]);
  unsigned char differences = strlen(code) != 64;
  for (int n = 0; n < 64 && !differences; n++) differences |= expected[n] ^ code[n];
  return !differences;
}

void drive(float x_m, float y_m, float heading_rad) { Serial.printf("%.3f %.3f %.3f\n", x_m, y_m, heading_rad); }
void stop_robot() { Serial.println("stop"); }

void setup() {
  Serial.begin(115200);
  WiFi.begin(NETWORK, PASSWORD);
  while (WiFi.status() != WL_CONNECTED) delay(200);
  udp.begin(PORT);  // for a multicast group: udp.beginMulticast(IPAddress(239, 255, 0, 1), PORT);
}

void loop() {
  static char text[2048];
  if (udp.parsePacket() > 0) {
    int length = udp.read(text, sizeof(text) - 1);
    text[length > 0 ? length : 0] = 0;
    char *code = strchr(text, '\n');
    if (code) *code++ = 0;
    JsonDocument pose;
    if (is_signed(text, strlen(text), code ? code : "") && !deserializeJson(pose, text) &&
        pose["ipsys"] == 1 && pose["robot"] == ROBOT) {
      uint64_t its_session = pose["session"];
      uint32_t its_sequence = pose["seq"];
      if (its_session > session || (its_session == session && its_sequence > sequence)) {
        session = its_session;
        sequence = its_sequence;
        if (!pose["stale"] && pose["heading_rad"].is<float>()) {
          last_ms = millis();
          drive(pose["x_m"], pose["y_m"], pose["heading_rad"]);
        }
      }
    }
  }
  if (millis() - last_ms > STOP_MS) stop_robot();
}
