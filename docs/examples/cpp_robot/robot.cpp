// A robot in C++ that speaks the bus: it reports its state 20 times a second, does what the safety filter says, and brakes
// by itself where no action of this very tick comes. Needs zenoh-cpp on zenoh-c (https://github.com/eclipse-zenoh) and
// msgpack-cxx:
//
//     c++ -std=c++17 -O2 -DZENOHCXX_ZENOHC robot.cpp -lzenohc -o robot
//     safedpa serve robot.toml --policy goal_seeker --listen tcp/127.0.0.1:7447        (robot = "car")
//     ./robot tcp/127.0.0.1:7447 fleet r1 10
//
// In place of a body it has the few lines of `move`; yours is a motor driver.

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <iostream>
#include <map>
#include <mutex>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include <msgpack.hpp>
#include <zenoh.hxx>

using Action = std::array<double, 2>;  // target speed [m/s], steering angle [rad]
using Clock = std::chrono::steady_clock;

constexpr double PERIOD = 0.05, WAITS = 0.9;  // s; share of the period in which an action counts
constexpr Action LOW{-0.6, -0.34}, HIGH{2.0, 0.34}, BRAKE{0.0, 0.0};
constexpr double WHEELBASE = 0.32, GAIN = 5.0, STRONGEST = 4.5;  // m, 1/s, m/s2

struct Answer {
    std::mutex lock;
    std::condition_variable there;
    std::uint64_t epoch = 0, tick = 0;
    std::optional<Action> action;
};

// The action, if it was computed from this start's state of this tick and lies within the limits. Nothing is clipped.
void hear(const std::vector<std::uint8_t>& payload, Answer& answer) try {
    const auto unpacked = msgpack::unpack(reinterpret_cast<const char*>(payload.data()), payload.size());
    const auto table = unpacked.get().as<std::map<std::string, msgpack::object>>();
    const auto values = table.at("values").as<std::vector<double>>();
    const std::scoped_lock held(answer.lock);
    if (table.at("epoch").as<std::uint64_t>() != answer.epoch || table.at("tick").as<std::uint64_t>() != answer.tick) return;
    if (values.size() != 2) return;
    for (std::size_t k = 0; k < 2; ++k)
        if (!(values[k] >= LOW[k] - 1e-9 && values[k] <= HIGH[k] + 1e-9)) return;
    answer.action = Action{values[0], values[1]};
    answer.there.notify_one();
} catch (const std::exception&) {
    // what cannot be read is no action
}

int main(int count, char** words) {
    if (count != 5) {
        std::cerr << "usage: robot ENDPOINT FLEET ROBOT SECONDS\n";
        return 2;
    }
    const std::string prefix = std::string("safedpa/") + words[2] + "/" + words[3] + "/";
    auto config = zenoh::Config::create_default();
    config.insert_json5("mode", "\"client\"");
    config.insert_json5("connect/endpoints", std::string("[\"") + words[1] + "\"]");
    auto session = zenoh::Session::open(std::move(config));

    Answer answer;
    answer.epoch = std::random_device{}() | std::uint64_t{1} << 32;  // drawn again at each start
    auto subscriber = session.declare_subscriber(
        zenoh::KeyExpr(prefix + "action"),
        [&](const zenoh::Sample& sample) { hear(sample.get_payload().as_vector(), answer); }, zenoh::closures::none);
    auto publisher = session.declare_publisher(zenoh::KeyExpr(prefix + "state"));

    double x = -2.0, y = 0.0, yaw = 0.0, speed = 0.0;
    Action applied = BRAKE;
    std::string applied_by = "none";
    long braked = 0;
    const long ticks = std::lround(std::stod(words[4]) / PERIOD);
    const auto start = Clock::now();
    const auto at = [&](double seconds) {
        return start + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
    };
    for (long tick = 0; tick < ticks; ++tick) {
        {
            const std::scoped_lock held(answer.lock);
            answer.tick = static_cast<std::uint64_t>(tick);
            answer.action.reset();
        }
        msgpack::sbuffer buffer;
        msgpack::packer<msgpack::sbuffer> pack(buffer);
        const auto list = [&](const char* name, const std::vector<double>& values) { pack.pack(name), pack.pack(values); };
        pack.pack_map(14);
        pack.pack("version"), pack.pack(1);
        pack.pack("epoch"), pack.pack(answer.epoch);
        pack.pack("tick"), pack.pack(static_cast<std::uint64_t>(tick));
        pack.pack("robot_time"), pack.pack(tick * PERIOD);
        pack.pack("publish_time"), pack.pack(std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count());
        list("values", {x, y, yaw, speed});
        list("applied", {applied[0], applied[1]});
        pack.pack("applied_by"), pack.pack(applied_by);
        pack.pack("period"), pack.pack(PERIOD);
        pack.pack("lockstep"), pack.pack(false);
        list("goal", {3.0, 0.0});
        pack.pack("obstacles"), pack.pack(std::vector<std::vector<double>>{{1.2, 0.15, 0.3}});  // x, y, radius [m]
        list("field", {-4.0, 4.0, -4.0, 4.0});
        list("footprint", {0.08, 0.4, 0.12});  // behind, ahead, radius [m]
        publisher.put(zenoh::Bytes(std::vector<std::uint8_t>(buffer.data(), buffer.data() + buffer.size())));

        std::optional<Action> action;
        {
            std::unique_lock held(answer.lock);
            answer.there.wait_until(held, at((tick + WAITS) * PERIOD), [&] { return answer.action.has_value(); });
            action = answer.action;
        }
        applied = action.value_or(BRAKE);
        applied_by = action ? "filter" : "watchdog";
        braked += !action;
        for (int step = 0; step < 20; ++step) {
            const double pace = PERIOD / 20;
            x += pace * speed * std::cos(yaw), y += pace * speed * std::sin(yaw);
            yaw += pace * speed * std::tan(applied[1]) / WHEELBASE;
            speed += pace * std::clamp(GAIN * (applied[0] - speed), -STRONGEST, STRONGEST);
        }
        std::this_thread::sleep_until(at((tick + 1) * PERIOD));
    }
    std::cout << "{\"ticks\": " << ticks << ", \"braked\": " << braked << ", \"x\": " << x << ", \"y\": " << y << "}\n";
}
