// Print the knee flexion ten times per second: ./knee [HOST [PORT [BASE]]]
// apt install g++ libmosquitto-dev nlohmann-json3-dev; g++ -std=c++17 -o knee knee.cpp -lmosquitto
#include <cstdio>
#include <string>

#include <mosquitto.h>
#include <nlohmann/json.hpp>

static void on_connect(mosquitto *client, void *base, int code) {
  if (code == 0)  // also after each reconnection
    mosquitto_subscribe(client, nullptr, (*static_cast<std::string *>(base) + "/pose/ui").c_str(), 0);
}

static void on_message(mosquitto *, void *, const mosquitto_message *message) {
  const char *text = static_cast<const char *>(message->payload);
  const auto pose = nlohmann::json::parse(text, text + message->payloadlen);
  const auto &knee = pose["joints"]["knee"];
  if (knee["flexion_deg"].is_null())
    std::puts("knee flexion unknown");
  else
    std::printf("knee flexion %.2f° ± %.2f°\n", knee["flexion_deg"].get<double>(), knee["sd_deg"].get<double>());
  std::fflush(stdout);
}

int main(int count, char **words) {
  std::string base = count > 3 ? words[3] : "jointfit/bench-1";
  mosquitto_lib_init();
  mosquitto *client = mosquitto_new(nullptr, true, &base);
  mosquitto_connect_callback_set(client, on_connect);
  mosquitto_message_callback_set(client, on_message);
  const int error = mosquitto_connect(client, count > 1 ? words[1] : "127.0.0.1", count > 2 ? std::stoi(words[2]) : 1883, 30);
  if (error != MOSQ_ERR_SUCCESS) return std::fprintf(stderr, "%s\n", mosquitto_strerror(error)), 1;
  return mosquitto_loop_forever(client, -1, 1);
}
